"""What a full link drops before it comes to a recording: counted, by the robot that put it and the recording that has
not had it."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

import macs_zenoh
from bridge.recording.bag import Bag
from bridge.recording.happened import happened
from bridge.recording.streams import LOST_BEFORE
from bridge.ros.counts import PutFor
from bridge.ros.stream import StreamFraming
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.messages import ROS, AddNode, Metadata, NodeType, StreamData, decode_data, encode_data
from macs_zenoh.protocol.robot_state import Offered, RobotStatus, StatusRequest, StopStatus, StreamCount
from macs_zenoh.streams import Streams
from tests.support.links import counted
from tests.support.local import patient, router_apart
from tests.support.programs import Program
from tests.support.waiting import until

TOPIC, NODE, TYPE = "/camera", "nd__camera", "std_msgs/String"
SIZE = 100_000
MESSAGES = 400
"""40 MB: a link that stands still has room for a few."""


class Robot:
    """A robot with one topic, which counts what it puts."""

    def __init__(self, agent: macs_zenoh.Agent) -> None:
        self._agent = agent
        self._streams = Streams(agent)
        self._put_for = PutFor()
        self.registered: list[tuple[int, int]] = []
        for verb in ("offers", "definitions", "add_node", "status"):
            agent.serve(verb, getattr(self, f"_{verb}"))

    async def _offers(self, _: macs_zenoh.Call) -> bytes:
        return encode_data(Offered(publishers={TOPIC: TYPE}))

    async def _definitions(self, _: macs_zenoh.Call) -> bytes:
        raise Refused("what is installed will do")

    async def _add_node(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(AddNode, call.data)
        self.registered = [(node.registrant_agent_type, node.registrant_agent_id)]
        self._put_for.registered(frozenset(self.registered))
        return b""

    async def _status(self, call: macs_zenoh.Call) -> bytes:
        asked = decode_data(StatusRequest, call.data).counts
        for each in self.registered:
            if asked and (count := self._put_for.to_tell(each, again=asked == "all")):
                self._publish(encode_data(count), StreamCount.manager)
        return encode_data(RobotStatus("/robot", False, StopStatus(), []))

    def publish(self) -> None:
        """One message."""
        self._publish(b"\0\1\0\0" + bytes(SIZE), StreamData.manager)
        self._put_for.add(frozenset(self.registered))

    def _publish(self, data: bytes, manager: str) -> None:
        metadata = Metadata(ROS, 7, 0, manager, NodeType.SUBSCRIBER, NODE, data_exchange_type=TYPE)
        self._streams.publish(NODE, StreamFraming(metadata, self.registered)(data))


@pytest.mark.megabytes
async def test_what_a_full_link_drops_is_counted(tmp_path: Path) -> None:
    """A recording's link stands still while a robot goes on: what is in the file, and what is counted as lost before,
    are together what the robot has put. The file says of which topic, and so do its events and the last line."""
    file = tmp_path / "a.mcap"
    async with (
        router_apart() as router,
        macs_zenoh.join("ros", id=7, settings=patient(router)) as agent,
        counted(router, buffer_bytes=65536) as link,
    ):
        robot = Robot(agent)
        async with Program("record", "--json", "-o", str(file), "-e", link.endpoint) as recording:
            await until(lambda: bool(robot.registered))
            robot.publish()
            link.hold_down()
            for _ in range(MESSAGES):
                robot.publish()
                await asyncio.sleep(0)
            link.release()
            robot.publish()
            await until(lambda: any("do not come here" in line for line in recording.log), 60)
            robot.publish()
        (ended,) = (json.loads(line) for line in recording.said[-1:])
    with Bag(file) as bag:
        (channel,) = (each for each in bag.channels.values() if each.topic == f"/7{TOPIC}")
        came = bag.counts[channel.id]
        told = [json.loads(each.data) for each in bag.messages(lambda channel: channel.topic == LOST_BEFORE)]
        lost = int(dict(bag.metadata())["macs.lost"]["before_recorder"])
        events = [event.text for event in happened(bag)]
    assert lost > 0
    assert came + lost == MESSAGES + 3
    assert ended["lost"] == {"before_recorder": lost}
    assert sum(each["more"] for each in told) == told[-1]["in_all"] == lost
    assert {(each["robot"], each["topic"]) for each in told} == {(7, TOPIC)}
    assert any(f"{told[0]['more']} messages of {TOPIC} did not come to the recording" in text for text in events)
