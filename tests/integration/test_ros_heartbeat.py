"""The heartbeat of our latched publishers beside that of Zenoh's own: who recovers lost messages sees the same."""

from __future__ import annotations

import queue

import pytest
import zenoh
import zenoh.ext

from macs_zenoh.mesh.heartbeat import Heartbeat
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.timeout(120)

AFTER_S = 0.2


def test_as_zenohs_own() -> None:
    """Key, number and quality of service, once after a burst; nothing after the end."""
    config = zenoh.Config()
    for name, value in {"listen/endpoints": "[]", "scouting/multicast/enabled": "false"}.items():
        config.insert_json5(name, value)
    with zenoh.open(config) as session:
        told: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        heard = [session.declare_subscriber(f"{key}/@adv/pub/**", told.put) for key in ("zenohs", "ours")]
        makers = {"zenohs": AFTER_S, "ours": None}
        theirs, ours = (
            zenoh.ext.declare_advanced_publisher(
                session,
                key,
                cache=zenoh.ext.CacheConfig(1),
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
            assert zenoh.ext.z_deserialize(zenoh.ext.UInt32, sample.payload) == 2
        assert len({str((each.priority, each.congestion_control, each.express)) for each in samples.values()}) == 1
        heartbeat.note(3)
        heartbeat.undeclare()
        heartbeat.note(4)
        theirs.put(b"")
        assert str(told.get(timeout=PATIENCE_S).key_expr).startswith("zenohs/")  # and nothing of ours before
        for each in (*heard, ours, theirs):
            each.undeclare()
