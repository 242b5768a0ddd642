"""Ends of a network test, a process each: ``python -m tests.network.ends robot|ros|headset OPTIONS``, see `inside`.

Each does what it is asked (`tests.support.workers`). A message is the CDR of a std_msgs/String: its number, the time
when it was sent, and filling.
"""

from __future__ import annotations

import asyncio
import importlib
import json
import logging
import struct
import sys
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from typing import Any

import macs_zenoh
from bridge.headset.client import Headset
from bridge.headset.nodes import Incoming
from macs_zenoh.config import MeshSettings
from macs_zenoh.protocol.messages import (
    AddNode,
    Metadata,
    NodeType,
    StreamData,
    decode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams
from tests.support.workers import serve

TYPE = "std_msgs/String"
HEADER = b"\0\1\0\0"
"""CDR, little endian."""
STALL_S = 0.25
"""A sender that is later than this says so: then the machine is too busy for what is measured."""


def packed(number: int, size: int) -> bytes:
    """A message of about ``size`` bytes."""
    text = b"%d %.6f " % (number, time.monotonic())
    text += b"x" * max(0, size - len(text) - 9) + b"\0"
    return HEADER + struct.pack("<I", len(text)) + text


class _End:
    """What robot and headset have in common: messages sent at a rate, and a list of those received."""

    def __init__(self) -> None:
        self._received: defaultdict[str, list[tuple[int, float, float, int, int]]] = defaultdict(list)
        self._sending: dict[str, asyncio.Task[None]] = {}
        self._sent: defaultdict[str, int] = defaultdict(int)
        self._late: defaultdict[str, int] = defaultdict(int)

    async def received(self, topic: str) -> list[tuple[int, float, float, int, int]]:
        """Number, time sent, time taken, size and sender of what came since this was asked for the last time."""
        return self._received.pop(topic, [])

    async def stop(self, topic: str) -> dict[str, int]:
        """Stop sending; how many messages were sent in all, and how many of them much too late."""
        if task := self._sending.pop(topic, None):
            task.cancel()
        return await self.sent(topic)

    async def sent(self, topic: str) -> dict[str, int]:
        """How many messages were sent so far, and how many of them much too late."""
        return {"sent": self._sent[topic], "late": self._late[topic]}

    def _note(self, topic: str, data: bytes, sender: int) -> None:
        number, sent, _ = data[8:].split(b" ", 2)
        self._received[topic].append((int(number), float(sent), time.monotonic() - float(sent), len(data), sender))

    def _send_at(self, topic: str, hz: float, size: int, send: Callable[[bytes], Awaitable[None]]) -> None:
        async def send_on() -> None:
            due = time.monotonic()
            while True:
                number = self._sent[topic]
                self._sent[topic] += 1
                await send(packed(number, size))
                due += 1 / hz
                pause_s = due - time.monotonic()
                self._late[topic] += pause_s < -STALL_S
                await asyncio.sleep(max(0.0, pause_s))

        self._sending[topic] = asyncio.create_task(send_on())


class RobotEnd(_End):
    """A robot without ROS: streams topics to who registered, takes commands, echoes those of ``/echo``."""

    def __init__(self, agent: macs_zenoh.Agent) -> None:
        super().__init__()
        self._agent = agent
        self._registrants: defaultdict[str, set[int]] = defaultdict(set)
        agent.serve("add_node", self._add)
        self._taking = asyncio.create_task(self._take())

    async def stream(self, topic: str, hz: float, size: int) -> None:
        """Publish a topic from now on."""

        async def send(cdr: bytes) -> None:
            self._put(topic, cdr)

        self._send_at(topic, hz, size, send)

    async def send(self, headset: int, size: int) -> None:
        """Send one message to a headset."""
        self._agent.send(packed(0, size), to="unity", ids=[headset])

    async def send_on(self, headset: int, hz: float, size: int) -> None:
        """Send messages to a headset from now on; each is kept until it is delivered, unlike what is streamed."""

        async def send(data: bytes) -> None:
            self._agent.send(data, to="unity", ids=[headset])

        self._send_at("", hz, size, send)

    async def registered(self, topic: str) -> list[int]:
        """The headsets that registered for a topic."""
        return sorted(self._registrants[node_name(topic)])

    async def online(self) -> list[tuple[str, int]]:
        """Everybody on the mesh, as this robot sees it: type and id."""
        return [(agent.type_name, agent.id) for agent in self._agent.online()]

    def _put(self, topic: str, cdr: bytes) -> None:
        node = node_name(topic)
        if not self._registrants[node]:
            return
        metadata = Metadata(1, self._agent.id, 0, StreamData.manager, NodeType.SUBSCRIBER, node, TYPE)
        management = encode_management(StreamData({"2": sorted(self._registrants[node])}))
        message = encode_message(metadata.encode(), cdr)
        Streams(self._agent).publish(node, encode_frame(1, management=management, message=message))

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(AddNode, call.data)
        if node.node_type == NodeType.SUBSCRIBER:
            self._registrants[node.node_name].add(node.registrant_agent_id)
        return b""

    async def _take(self) -> None:
        async for message in self._agent:
            name = message.metadata.node_name
            self._note("/" + name.removeprefix("nd__") if name else "", message.data, message.sender_id)
            if name == node_name("/echo"):
                self._agent.send(message.data, to="unity", ids=[message.sender_id])


class HeadsetEnd(_End):
    """A headset: receives topics, publishes commands, sends messages."""

    def __init__(self, headset: Headset) -> None:
        super().__init__()
        self._headset = headset
        self._taking = asyncio.create_task(self._take())

    async def subscribe(self, topic: str, robot: int) -> None:
        """Receive a topic from now on."""

        def note(message: Incoming) -> None:
            self._note(topic, message.data, message.sender_id or 0)

        await self._headset.subscribe(topic, TYPE, agents=[robot], buffer_size=100, callback=note)

    async def command(self, topic: str, robot: int, hz: float, size: int = 100) -> None:
        """Publish commands to a robot from now on."""

        async def send(cdr: bytes) -> None:
            await self._headset.publish(topic, TYPE, cdr, agents=[robot])

        self._send_at(topic, hz, size, send)

    async def send(self, robot: int, size: int) -> None:
        """Send one message to a robot."""
        await self._headset.send(packed(0, size), to=1, ids=[robot])

    async def own_id(self) -> int:
        """The id that the gateway gave it."""
        return self._headset.id

    async def online(self) -> list[tuple[str, int]]:
        """Everybody on the mesh, as its gateway sees it: type and id."""
        reply = await self._headset.online()
        return [*(("ros", i) for i in reply.ros_agent_ids), *(("unity", i) for i in reply.unity_agent_ids)]

    async def _take(self) -> None:
        async for message in self._headset:
            if message.data:
                self._note("", message.data, message.sender_id or 0)


def ros_type(name: str) -> Any:
    """The message class of a type, as std_msgs/String."""
    package, _, kind = name.partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


class RosEnd(_End):
    """A ROS node on a robot, beside its `macs agent`."""

    def __init__(self, peer: Any) -> None:
        super().__init__()
        self._peer = peer

    async def stream(self, topic: str, hz: float, size: int) -> None:
        """Publish a topic from now on, once somebody subscribes to it."""
        publisher = await self._peer.publisher(ros_type(TYPE), topic, 1, matched=1)

        async def send(cdr: bytes) -> None:
            publisher.publish(cdr)

        self._send_at(topic, hz, size, send)

    async def subscribe(self, topic: str) -> None:
        """Take a topic from now on."""
        session = self._peer.session

        def note(cdr: bytes) -> None:
            self._note(topic, cdr, 0)

        await session.run(lambda: session.node.create_subscription(ros_type(TYPE), topic, note, 100, raw=True))


async def _robot(stack: AsyncExitStack, options: dict[str, Any]) -> _End:
    agent_id = options.pop("id")
    settings = MeshSettings(**options)
    return RobotEnd(await stack.enter_async_context(macs_zenoh.join("ros", id=agent_id, settings=settings)))


async def _ros(stack: AsyncExitStack, options: dict[str, Any]) -> _End:
    from tests.support.ros_peer import Peer

    peer = Peer(options["domain"])
    stack.callback(peer.session.close)
    return RosEnd(peer)


async def _headset(stack: AsyncExitStack, options: dict[str, Any]) -> _End:
    headset = await Headset.connect("127.0.0.1", **options)
    return HeadsetEnd(await stack.enter_async_context(headset))


async def run(kind: str, options: dict[str, Any]) -> None:
    """Be such an end until the input ends."""
    async with AsyncExitStack() as stack:
        await serve({"robot": _robot, "ros": _ros, "headset": _headset}[kind](stack, options))


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO)
    asyncio.run(run(sys.argv[1], json.loads(sys.argv[2])))
