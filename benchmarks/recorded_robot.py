"""A worker that is a robot on the mesh, without ROS, with a camera and a quick sensor, for recordings.

``python -m benchmarks.recorded_robot PORT ID`` joins the router on that port of 127.0.0.1. What it publishes carries
stamps as those of `benchmarks.robot_ends`.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
import time
from typing import Any

import msgspec
import uvloop

import macs_zenoh
from bridge.ros.counts import PutFor
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AddNode,
    Metadata,
    NodeType,
    StreamData,
    decode_data,
    encode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.robot_state import Offered, RobotStatus, StatusRequest, StopStatus, StreamCount, TopicQos
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams

from .robot_ends import AT, PREFIX, TYPE, pace, stamped
from .worker import say

TOPICS = ("/image", "/small")


class Robot:
    """Two topics and who registered on them."""

    def __init__(self, agent: macs_zenoh.Agent) -> None:
        self._agent = agent
        self._streams = Streams(agent)
        self._registered: dict[str, tuple[AddNode, set[int]]] = {}
        self._put_for = {topic: PutFor() for topic in TOPICS}
        self._kept: dict[str, set[int]] = {}
        self._publishing: list[threading.Thread] = []

    async def offers(self, _: macs_zenoh.Call) -> bytes:
        """Both topics."""
        offered = Offered(
            publishers=dict.fromkeys(TOPICS, TYPE), qos=dict.fromkeys(TOPICS, TopicQos("reliable", "volatile"))
        )
        return msgspec.json.encode(offered)

    async def definitions(self, _: macs_zenoh.Call) -> bytes:
        """What it does not tell; its type is a standard one."""
        raise Refused("look it up")

    async def add_node(self, call: macs_zenoh.Call) -> bytes:
        """Somebody registers."""
        node = decode_data(AddNode, call.data)
        _, registrants = self._registered.setdefault(node.tos_name, (node, set()))
        registrants.add(node.registrant_agent_id)
        self._put_for[node.tos_name].registered(frozenset((UNITY, registrant) for registrant in registrants))
        return b""

    async def status(self, call: macs_zenoh.Call) -> bytes:
        """Nothing but how much was put."""
        asked, to = decode_data(StatusRequest, call.data).counts if call.data else "", (UNITY, call.sender_id)
        for topic, put_for in self._put_for.items():
            if asked and (count := put_for.to_tell(to, again=asked == "all")):
                message = encode_message(self._metadata(topic, StreamCount.manager).encode(), encode_data(count))
                targets = encode_management(StreamData({str(UNITY): [call.sender_id]}))
                self._streams.publish(node_name(topic), encode_frame(ROS, management=targets, message=message))
        return encode_data(RobotStatus("/bench", False, StopStatus(), []))

    async def registrants(self) -> dict[str, Any]:
        """How many each topic has."""
        return {topic: len(self._registered.get(topic, (None, ()))[1]) for topic in TOPICS}

    async def keep(self) -> dict[str, Any]:
        """Those who are registered now stay so whatever comes."""
        self._kept = {topic: set(registrants) for topic, (_, registrants) in self._registered.items()}
        return {}

    async def forget(self) -> dict[str, Any]:
        """Nobody is registered but those."""
        for topic in list(self._registered):
            self._registered[topic] = (self._registered[topic][0], set(self._kept.get(topic, ())))
            self._put_for[topic].registered(frozenset((UNITY, each) for each in self._registered[topic][1]))
        return {}

    async def publish(self, topic: str, size: int, hz: float, count: int) -> dict[str, Any]:
        """Begin to publish at a rate, to who is registered now or to nobody."""
        known = self._registered.get(topic)
        node = node_name(topic)
        targets = StreamData({str(UNITY): sorted(known[1]) if known else []})
        receivers, put_for = frozenset((UNITY, each) for each in targets.dest_agents[str(UNITY)]), self._put_for[topic]
        metadata = self._metadata(topic, StreamData.manager)
        cdr = stamped(size)
        cdr[len(PREFIX) + 4 :] = os.urandom(size)
        message = encode_message(metadata.encode(), bytes(cdr))
        frame = bytearray(encode_frame(ROS, management=encode_management(targets), message=message))
        at = len(frame) - len(cdr) + AT

        def put(message: bytearray) -> None:
            self._streams.publish(node, bytes(message))
            put_for.add(receivers)

        thread = threading.Thread(target=pace, args=(count, hz, put, frame, at))
        thread.start()
        self._publishing.append(thread)
        return {}

    def _metadata(self, topic: str, manager: str) -> Metadata:
        return Metadata(
            ROS,
            self._agent.id,
            message_manager=manager,
            node_type=NodeType.SUBSCRIBER,
            node_name=node_name(topic),
            data_exchange_type=TYPE,
        )

    async def published(self) -> dict[str, Any]:
        """Wait until all of it is published."""
        for thread in self._publishing:
            await asyncio.to_thread(thread.join)
        self._publishing.clear()
        return {"ended": time.monotonic()}


async def main() -> None:
    """Run the worker."""
    loop = asyncio.get_running_loop()
    async with macs_zenoh.join("ros", id=int(sys.argv[2]), connect=[f"tcp/127.0.0.1:{sys.argv[1]}"]) as agent:
        robot = Robot(agent)
        agent.serve("add_node", robot.add_node)
        agent.serve("offers", robot.offers)
        agent.serve("definitions", robot.definitions)
        agent.serve("status", robot.status)
        say({})
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            command = json.loads(line)
            say(await getattr(robot, command.pop("do"))(**command))


if __name__ == "__main__":
    uvloop.run(main())
