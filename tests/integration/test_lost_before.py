"""What is lost of a robot's topic between the robot and a gateway: Zenoh tells nobody, so both count."""

from __future__ import annotations

import asyncio
import threading

import pytest

import macs_zenoh
from bridge.gateway.on_the_way import BEFORE
from macs_zenoh import TrafficRule, streams
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.protocol.messages import ROS, Metadata, NodeType, StreamData, decode_data, encode_management
from macs_zenoh.protocol.robot_state import StreamCount
from macs_zenoh.protocol.wire import encode_frame, encode_message, parse_frame
from macs_zenoh.streams import Streams
from tests.support.given import Connect, StartGateway
from tests.support.links import counted
from tests.support.local import patient, router_apart
from tests.support.waiting import PATIENCE_S, until

NODE, TYPE = "nd__camera", "std_msgs/UInt8MultiArray"
KEY = STREAM.of(type=ROS, id=7, node=NODE)
SIZE, MESSAGES = 100_000, 400
"""40 MB: a link that stands still has room for a few."""


@pytest.mark.megabytes
async def test_what_a_full_link_drops_is_counted(
    start_gateway: StartGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway's link stands still while a robot goes on: what has come and what is counted as lost on the way are
    together what the robot has put."""
    for name in ("FIRST_S", "TELL_S"):
        monkeypatch.setattr(streams, name, 0.05)
    async with (
        router_apart() as router,
        macs_zenoh.join("ros", id=7, settings=patient(router)) as agent,
        counted(router, buffer_bytes=65536) as link,
    ):

        async def add(call: macs_zenoh.Call) -> bytes:
            return b""

        agent.serve("add_node", add)
        gateway = await start_gateway(link.endpoint)
        headset = await connect(gateway)
        taken: list[object] = []
        await headset.subscribe("/camera", TYPE, agents=[7], callback=taken.append)
        robot = Streams(agent)
        listed = encode_management(StreamData({"2": [headset.id]}))
        about = Metadata(ROS, 7, 0, StreamData.manager, NodeType.SUBSCRIBER, NODE, data_exchange_type=TYPE)

        def publish(size: int = 12) -> None:
            message = encode_message(about.encode(), b"\0\1\0\0" + bytes(size))
            robot.publish(NODE, encode_frame(ROS, management=listed, message=message))

        await until(lambda: KEY in gateway._delivery.streams)
        came = gateway._delivery.streams[KEY].came
        while came.since is None:
            publish()
            await asyncio.sleep(0.01)
        put = robot._put[NODE]
        await until(lambda: put.count - came.samples == came.before)
        link.hold_down()
        for _ in range(MESSAGES):
            publish(SIZE)
            await asyncio.sleep(0)
        link.release()

        def settled() -> bool:
            if put.count - came.samples - came.lost == came.before:
                return True
            publish()  # counts are dropped as well, while the link is full
            return False

        await until(settled, every_s=0.1)
        assert gateway.drops[BEFORE] == came.lost > 0
        assert taken


async def test_no_count_is_behind_a_message_that_it_leaves_out(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What another thread is putting just then is told with it; the loop does not wait for that."""
    for name in ("FIRST_S", "TELL_S"):
        monkeypatch.setattr(streams, name, 0.0)
    went: list[bytes] = []
    putting, goes_on = threading.Event(), threading.Event()
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as agent:
        await until(lambda: agent.mesh.linked)
        put_here = agent.mesh.streams.put_here

        def noted(key: str, payload: bytes, **how: bool) -> bool:
            is_put = put_here(key, payload, **how)
            went.append(payload)
            if payload == b"slow":
                putting.set()
                assert goes_on.wait(PATIENCE_S)
            return is_put

        monkeypatch.setattr(agent.mesh.streams, "put_here", noted)
        robot = Streams(agent)
        robot.publish(NODE, b"first")
        slow = asyncio.ensure_future(asyncio.to_thread(robot.publish, NODE, b"slow"))
        try:
            await until(putting.is_set)
            robot._look()
            assert went[-1] == b"slow"
        finally:
            goes_on.set()
            await slow
        at = went.index(b"slow")
        assert decode_data(StreamCount, bytes(parse_frame(went[at + 1]).body)).put == 2


async def test_a_count_uses_up_nothing_of_a_rule(router: str) -> None:
    """What a rule drops the robot counts itself, and did not put; a count passes."""
    rule = TrafficRule(match="**", max_bytes=10)
    async with await Mesh.open(patient(router), traffic=[rule]) as mesh:
        await until(lambda: mesh.linked)
        assert mesh.streams.put_here(KEY, bytes(10))
        assert not mesh.streams.put_here(KEY, bytes(11))
        assert mesh.streams.put_here(KEY, bytes(11), ruled=False)
        assert mesh.drops == {"over_size": 1}
