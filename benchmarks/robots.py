"""A worker that is several robots on the mesh, without ROS: they take every registration.

``python -m benchmarks.robots PORT COUNT`` joins the router on that port of 127.0.0.1 as robots 1 to COUNT.
"""

from __future__ import annotations

import asyncio
import json
import sys
from contextlib import AsyncExitStack
from typing import Any

import uvloop

import macs_zenoh
from macs_zenoh.protocol.messages import AddNode, RemoveNode, decode_data

from .worker import say


class Robots:
    """Who registered on what, over all robots."""

    def __init__(self, first: macs_zenoh.Agent) -> None:
        self._first = first
        self._registered: set[tuple[int, int, str]] = set()

    def serve(self, agent: macs_zenoh.Agent) -> None:
        """Let a robot take registrations."""

        async def add_node(call: macs_zenoh.Call) -> bytes:
            node = decode_data(AddNode, call.data)
            self._registered.add((agent.id, node.registrant_agent_id, node.node_name))
            return b""

        async def remove_node(call: macs_zenoh.Call) -> bytes:
            node = decode_data(RemoveNode, call.data)
            self._registered.discard((agent.id, node.registrant_agent_id, node.node_name))
            return b""

        agent.serve("add_node", add_node)
        agent.serve("remove_node", remove_node)

    def count(self) -> dict[str, Any]:
        """How many registrations there were since `forget`, and how many headsets are online."""
        return {"registered": len(self._registered), "headsets": len(self._first.directory.ids(2))}

    def forget(self) -> dict[str, Any]:
        """Count from 0."""
        self._registered.clear()
        return {}


async def main() -> None:
    """Run the worker."""
    loop = asyncio.get_running_loop()
    async with AsyncExitStack() as stack:
        connect = [f"tcp/127.0.0.1:{sys.argv[1]}"]
        joining = (macs_zenoh.join("ros", id=i, connect=connect) for i in range(1, int(sys.argv[2]) + 1))
        agents = [await stack.enter_async_context(agent) for agent in joining]
        robots = Robots(agents[0])
        for agent in agents:
            robots.serve(agent)
        say({})
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            say(getattr(robots, json.loads(line)["do"])())


if __name__ == "__main__":
    uvloop.run(main())
