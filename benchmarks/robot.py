"""A worker that is robot 1 on the mesh, without ROS: publishes topic data to who registered, answers messages.

``python -m benchmarks.robot PORT`` joins the router on that port of 127.0.0.1.
"""

from __future__ import annotations

import asyncio
import json
import sys
from typing import Any

import uvloop

import macs_zenoh
from macs_zenoh.protocol.existing import CDR
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AddNode,
    Metadata,
    NodeType,
    StreamData,
    decode_data,
    encode_management,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams

from .worker import say


class Robot:
    """One topic and who registered on it."""

    def __init__(self, agent: macs_zenoh.Agent) -> None:
        self.agent = agent
        self.node: AddNode | None = None
        self.registrants: set[int] = set()

    async def add_node(self, call: macs_zenoh.Call) -> bytes:
        """A headset registers."""
        self.node = decode_data(AddNode, call.data)
        self.registrants.add(self.node.registrant_agent_id)
        return b""

    async def count(self) -> dict[str, Any]:
        """How many have registered."""
        return {"registrants": len(self.registrants)}

    async def publish(self, size: int, count: int, pause_s: float) -> dict[str, Any]:
        """Publish ``count`` messages, one every ``pause_s``: slow enough that the link drops none of them."""
        assert self.node is not None
        metadata = Metadata(
            ROS,
            self.agent.id,
            message_manager=StreamData.manager,
            node_type=NodeType.SUBSCRIBER,
            node_name=self.node.node_name,
            data_exchange_type=self.node.data_exchange_type,
        )
        message = encode_message(metadata.encode(), (CDR + bytes(size))[:size])
        targets = StreamData({str(UNITY): sorted(self.registrants)})
        frame = encode_frame(ROS, management=encode_management(targets), message=message)
        streams = Streams(self.agent)
        for _ in range(count):
            streams.publish(self.node.node_name, frame)
            await asyncio.sleep(pause_s)
        return {"frame_bytes": len(frame), "message_bytes": len(message)}

    async def echo(self) -> None:
        """Answer every message with its own data, for ever."""
        async for message in self.agent:
            self.agent.send(message.data, to=message.sender_type, ids=[message.sender_id])

    async def answer_bytes(self, size: int) -> dict[str, Any]:
        """How long such an answer is with ``size`` bytes of data."""
        return {"answer_bytes": len(encode_message(Metadata(ROS, self.agent.id).encode(), bytes(size)))}


async def main() -> None:
    """Run the worker."""
    loop = asyncio.get_running_loop()
    async with macs_zenoh.join("ros", id=1, connect=[f"tcp/127.0.0.1:{sys.argv[1]}"]) as agent:
        robot = Robot(agent)
        agent.serve("add_node", robot.add_node)
        echoing = loop.create_task(robot.echo())
        say({})
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            command = json.loads(line)
            say(await getattr(robot, command.pop("do"))(**command))
        echoing.cancel()


if __name__ == "__main__":
    uvloop.run(main())
