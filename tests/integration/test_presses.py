"""A headset's emergency stop: its gateway asks the robot for it as well, in the headset's name."""

from __future__ import annotations

import asyncio

import pytest

import macs_zenoh
from macs_zenoh.agent import Agent
from macs_zenoh.protocol.messages import Metadata, NodeType
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.serving import Call
from tests.support.given import Connect, StartGateway
from tests.support.waiting import until

STOP = Metadata(node_type=NodeType.PUBLISHER, node_name="nd__emergency_stop", data_exchange_type="std_msgs/Bool")
PRESS, RELEASE = b"\x00\x01\x00\x00\x01", b"\x00\x01\x00\x00\x00"


class Asked:
    """A robot that notes who asks it for what."""

    def __init__(self, agent: Agent) -> None:
        self.calls: list[Call] = []
        agent.serve("stop", self._stop)

    async def _stop(self, call: Call) -> bytes:
        self.calls.append(call)
        return b""


def said(
    data: bytes, to: int = 1, ids: tuple[int, ...] = (), groups: tuple[int, ...] = (), about: Metadata = STOP
) -> bytes:
    """What a headset sends."""
    return encode_frame(to, ids, groups, message=encode_message(about.encode(), data))


@pytest.mark.parametrize(
    "frame", [said(PRESS, ids=(7,)), said(PRESS, groups=(3,)), said(PRESS, to=0)], ids=["id", "group", "all"]
)
async def test_a_press_is_asked_for_as_well(
    router: str, start_gateway: StartGateway, connect: Connect, frame: bytes
) -> None:
    """To robots by id, by group or to all: each is asked for the stop, by the headset; the data goes to it too."""
    gateway = await start_gateway()
    async with macs_zenoh.join("ros", id=7, group=3, connect=[router]) as robot:
        asked = Asked(robot)
        headset = await connect(gateway)
        await until(lambda: (1, 7) in gateway.directory)
        await headset.send_frame(frame)
        await until(lambda: asked.calls)
        call = asked.calls[0]
        assert (call.sender_type, call.sender_id, call.data) == ("unity", headset.id, b"true")
        assert call.metadata.node_name == STOP.node_name
        message = await asyncio.wait_for(robot.receive(), 10)
        assert message.data == PRESS


async def test_nothing_else_is_asked_for(router: str, start_gateway: StartGateway, connect: Connect) -> None:
    """A release, another Bool and a message to a headset ask no robot for a stop; a press after them does, once."""
    gateway = await start_gateway()
    async with macs_zenoh.join("ros", id=7, connect=[router]) as robot:
        asked = Asked(robot)
        headset = await connect(gateway)
        await until(lambda: (1, 7) in gateway.directory)
        lamp = Metadata(node_type=NodeType.PUBLISHER, node_name="nd__lamp", data_exchange_type="std_msgs/Bool")
        for frame in (said(RELEASE, ids=(7,)), said(PRESS, ids=(7,), about=lamp), said(PRESS, to=2, ids=(7,))):
            await headset.send_frame(frame)
        await headset.send_frame(said(b"", ids=(7,)))
        for expected in (RELEASE, PRESS, b""):
            assert (await asyncio.wait_for(robot.receive(), 10)).data == expected
        await headset.send_frame(said(PRESS, ids=(7,)))
        assert (await asyncio.wait_for(robot.receive(), 10)).data == PRESS
        await until(lambda: asked.calls)
        await asyncio.sleep(0.2)
        assert len(asked.calls) == 1
