"""The heartbeats of our publishers beside those of Zenoh's own: who recovers lost messages sees the same. And none of
them keeps a program from going on."""

from __future__ import annotations

import asyncio
import queue
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh
import zenoh.ext

from macs_zenoh.mesh.heartbeat import Counted, Heartbeat, Heartbeats
from tests.support.processes import ROOT, Process
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.timeout(300)

AFTER_S = 0.2
KEPT = zenoh.ext.CacheConfig(1)


@contextmanager
def alone() -> Iterator[zenoh.Session]:
    """A session that nobody else hears."""
    config = zenoh.Config()
    for name, value in {"listen/endpoints": "[]", "scouting/multicast/enabled": "false"}.items():
        config.insert_json5(name, value)
    with zenoh.open(config) as session:
        yield session


def way(sample: zenoh.Sample) -> str:
    """How a sample travels."""
    return str((sample.priority, sample.congestion_control, sample.express))


def number_of(sample: zenoh.Sample) -> int:
    """What a heartbeat tells, as Zenoh reads it."""
    return int(zenoh.ext.z_deserialize(zenoh.ext.UInt32, sample.payload))


def test_as_zenohs_own() -> None:
    """Key, number and quality of service, once after a burst; nothing after the end."""
    with alone() as session:
        told: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        heard = [session.declare_subscriber(f"{key}/@adv/pub/**", told.put) for key in ("zenohs", "ours")]
        makers = {"zenohs": AFTER_S, "ours": None}
        theirs, ours = (
            zenoh.ext.declare_advanced_publisher(
                session,
                key,
                cache=KEPT,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=after_s),
            )
            for key, after_s in makers.items()
        )
        heartbeat = Heartbeat(session, "ours", ours, AFTER_S)
        for number in range(3):
            theirs.put(b"")
            ours.put(b"")
            heartbeat.note(number)
        samples: dict[str, zenoh.Sample] = {}
        while len(samples) < 2:
            sample = told.get(timeout=PATIENCE_S)
            samples[str(sample.key_expr).partition("/")[0]] = sample
        for name, publisher in (("zenohs", theirs), ("ours", ours)):
            sample, own = samples[name], publisher.id
            assert str(sample.key_expr) == f"{name}/@adv/pub/{own.zid}/{own.eid}/_"
            assert number_of(sample) == 2
        assert len({way(each) for each in samples.values()}) == 1
        heartbeat.note(3)
        heartbeat.undeclare()
        heartbeat.note(4)
        theirs.put(b"")
        assert str(told.get(timeout=PATIENCE_S).key_expr).startswith("zenohs/")  # and nothing of ours before
        for each in (*heard, ours, theirs):
            each.undeclare()


def test_again_and_again_as_zenohs_own() -> None:
    """Key, number and quality of service, also while nothing is put; nothing before the first message, and nothing
    when nobody has the publisher any more."""
    with alone() as session:
        told: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        heard = [session.declare_subscriber(f"{key}/@adv/pub/**", told.put) for key in ("zenohs", "ours", "silent")]
        theirs, inner, silent = (
            zenoh.ext.declare_advanced_publisher(
                session,
                key,
                cache=KEPT,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=every_s, sporadic_heartbeat=None),
            )
            for key, every_s in (("zenohs", AFTER_S), ("ours", None), ("silent", None))
        )
        heartbeats = Heartbeats(AFTER_S)
        ours, nothing = Counted(session, "ours", inner), Counted(session, "silent", silent)
        for counted in (ours, nothing):
            heartbeats.add(counted)
        for _ in range(3):
            theirs.put(b"")
            ours.put(b"")
        samples: dict[str, list[zenoh.Sample]] = {"zenohs": [], "ours": []}
        while min(map(len, samples.values())) < 3:
            sample = told.get(timeout=PATIENCE_S)
            if number_of(sample) == 2:  # one may have come between two messages
                samples[str(sample.key_expr).partition("/")[0]].append(sample)
        for name, publisher in (("zenohs", theirs), ("ours", inner)):
            own = publisher.id
            assert {str(sample.key_expr) for sample in samples[name]} == {f"{name}/@adv/pub/{own.zid}/{own.eid}/_"}
        assert len({way(each) for several in samples.values() for each in several}) == 1
        ours.put(b"")
        while number_of(told.get(timeout=PATIENCE_S)) != 3:
            pass
        del ours
        keys = [str(told.get(timeout=PATIENCE_S).key_expr) for _ in range(8)]
        assert all(key.startswith("zenohs/") for key in keys[3:])  # one of ours may have been on its way
        heartbeats.close(PATIENCE_S)
        for each in (*heard, inner, silent, theirs):
            each.undeclare()


FLOOD = """
import sys, zenoh
config = zenoh.Config()
for name, value in {"mode": '"client"', "connect/endpoints": f'["{sys.argv[1]}"]'}.items():
    config.insert_json5(name, value)
with zenoh.open(config) as session:
    print("ready: it floods", flush=True)
    while True:
        for token in [session.liveliness().declare_token(f"many/{number}") for number in range(100)]:
            token.undeclare()
"""
BUSY = """
import asyncio, faulthandler, sys
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh, Traffic

KEY = "macs/from/ros/7/nd__log"

async def main():
    settings, seen = MeshSettings(connect=[sys.argv[1]]), []
    async with await Mesh.open(settings) as mesh, await Mesh.open(settings) as other:
        watching = [each.watch_tokens("many/**", lambda *token: seen.append(token)) for each in (mesh, other) * 4]
        while not seen:
            await asyncio.sleep(0.01)
        for _ in range(300):
            faulthandler.dump_traceback_later(60, exit=True)  # by a thread that needs no turn of Python's
            assert mesh.keep(KEY, 10)
            mesh.put(KEY, b"", Traffic.STREAM)
            mesh.keep(KEY, None)
            await asyncio.sleep(0.001)
        faulthandler.cancel_dump_traceback_later()
        assert watching

asyncio.run(main())
"""


async def test_letting_go_of_what_is_kept_hangs_nothing() -> None:
    """Three hundred times, while all threads of Zenoh's call back for others who come and go."""
    async with Router() as router, Process(sys.executable, "-c", FLOOD, router.endpoint):
        busy = await asyncio.create_subprocess_exec(
            sys.executable, "-c", BUSY, router.endpoint, cwd=ROOT, stderr=asyncio.subprocess.PIPE
        )
        _, log = await busy.communicate()
    assert busy.returncode == 0, log.decode()
