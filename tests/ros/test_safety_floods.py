"""Whatever anybody floods the robot with, stops take effect, commands of others pass, and memory is bounded.

How fast, is measured by `python -m tests.attack --section 3`: a test that others run beside it cannot tell.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Bool

from macs_zenoh.agent import Agent
from macs_zenoh.protocol.keyexpr import CALL, GROUP
from macs_zenoh.protocol.messages import Metadata, NodeType
from macs_zenoh.protocol.routing import unicast_key
from macs_zenoh.protocol.wire import encode_frame, encode_message
from tests.ros.driven import SETTINGS, STOPPED, Heard, driving, hear, may_command, send_bool, site, told
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, until

ROBOT, FLOODER = 1, 4000
GROWTH_MIB = 150


def frame(metadata: Metadata, data: bytes = b"") -> bytes:
    return encode_frame(1, (ROBOT,), (3,), message=encode_message(metadata.encode(), data))


TWIST = b"\x00\x01\x00\x00" + bytes(48)
STATUS = frame(Metadata(message_manager="RobotStatus"))
COMMAND = frame(Metadata(node_type=NodeType.PUBLISHER, node_name="nd__cmd_vel"), TWIST)
RELEASE = frame(Metadata(node_type=NodeType.PUBLISHER, node_name="nd__emergency_stop"), b"\x00\x01\x00\x00\x00")
ASKED = frame(Metadata(), b"false")
SERVICE = frame(Metadata(node_type=NodeType.CLIENT, node_name="nd__no"), b"\x00\x01\x00\x00")

INBOX = unicast_key(1, ROBOT, 2, FLOODER)
BY_GROUP = GROUP.of(group=3, type=1, from_type=2, from_id=FLOODER)


def call(verb: str) -> str:
    return CALL.of(type=1, id=ROBOT, verb=verb, from_type=2, from_id=FLOODER)


PUTS = {
    "status": (INBOX, STATUS, False),
    "status in runs": (INBOX, STATUS * 300, False),
    "status by group": (BY_GROUP, STATUS, False),
    "commands": (INBOX, COMMAND, True),
    "commands in runs": (INBOX, COMMAND * 300, True),
    "releases": (INBOX, RELEASE, True),
    "service calls": (INBOX, SERVICE, False),
    "nonsense": (INBOX, bytes(200), True),
}
QUERIES = {"status queries": "status", "offers queries": "offers", "stop queries": "stop"}


def put_all_the_time(endpoint: str, name: str) -> None:
    """The flooder, a process of its own with a plain Zenoh session."""
    import zenoh

    config = zenoh.Config()
    for path, value in (("mode", '"client"'), ("connect/endpoints", f'["{endpoint}"]')):
        config.insert_json5(path, value)
    config.insert_json5("scouting/multicast/enabled", "false")
    session = zenoh.open(config)
    if name in PUTS:
        key, payload, urgent = PUTS[name]
        publisher = session.declare_publisher(
            key,
            priority=zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.INTERACTIVE_HIGH,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        while True:
            publisher.put(payload)
    while True:
        for _ in range(100):
            session.get(call(QUERIES[name]), zenoh.handlers.Callback(lambda _: None), payload=ASKED, timeout=1.0)
        time.sleep(0.005)


@contextmanager
def flooding(endpoint: str, name: str) -> Iterator[None]:
    process = multiprocessing.get_context("spawn").Process(target=put_all_the_time, args=(endpoint, name), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


def resident_mib(pid: int) -> int:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) // 1024
    raise AssertionError("no such process")


async def drives(heard: Heard) -> None:
    since = time.monotonic()
    await until(lambda: 0.5 in heard.since(since))


USUAL = ("status in runs", "commands", "stop queries")
"""One that waits in queues, one that is judged where it comes, one that asks: the others have once been faults too."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in USUAL else pytest.mark.soak) for name in (*PUTS, *QUERIES)]
)
async def test_a_stop_pressed_once_takes_effect(domain: int, peer: Peer, tmp_path: Path, name: str) -> None:
    """A headset's stop that is sent once, an operator's, and the dead-man when the driver falls silent; and nothing of
    the flood stays in memory."""
    heard, shown = await hear(peer), await watch(peer)
    async with (
        site(domain, tmp_path, SETTINGS.format(deadman_s=0.5) + "exclusive = true") as place,
        place.robot(ROBOT, "--group", "3") as robot,
        place.headset(300) as driver,
        place.headset(301) as presser,
    ):
        await may_command(driver, ROBOT)
        before = resident_mib(robot.pid)
        with flooding(place.router.endpoint, name):
            async with driving(driver, ROBOT):
                await flooded(driver)
                await drives(heard)
                send_bool(presser, ROBOT, True)
                await until(lambda: shown.last)
                await stays_stopped(heard)
                await release(presser)
                await drives(heard)
                await presser.call("ros", ROBOT, "stop", b"true")
                await until(lambda: heard.last == STOPPED)
                await release(presser)
                await drives(heard)
            await until(lambda: heard.last == STOPPED)  # the dead-man
            grown = resident_mib(robot.pid) - before
        assert grown < GROWTH_MIB, f"{grown} MiB"


async def flooded(agent: Agent) -> None:
    """Wait until the flood is there, and drops."""
    deadline = time.monotonic() + PATIENCE_S
    while not (await told(agent, ROBOT))["drops"].get("flooded"):
        assert time.monotonic() < deadline, "nothing of the flood was dropped for being one"
        await asyncio.sleep(0.1)


@dataclass
class Shown:
    """The emergency stop as its topic shows it."""

    last: bool = False

    def take(self, state: Bool) -> None:
        self.last = state.data


async def watch(peer: Peer) -> Shown:
    shown = Shown()
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    await peer.session.run(lambda: peer.session.node.create_subscription(Bool, "/emergency_stop", shown.take, latched))
    return shown


async def stays_stopped(heard: Heard) -> None:
    await until(lambda: heard.last == STOPPED)
    count = len(heard.values)
    await asyncio.sleep(0.3)
    assert len(heard.values) == count, "a command was carried out after the stop"


async def release(presser: Agent) -> None:
    await presser.call("ros", ROBOT, "stop", b"false")
