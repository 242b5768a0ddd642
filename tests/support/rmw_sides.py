"""Both sides of a robot whose nodes run ROS's Zenoh middleware, in this process: ours, and its nodes' network."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

from bridge.rmw_zenoh.session import ZenohSession
from bridge.rmw_zenoh.types import KnownTypes
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.ros_network import RosNetwork


@asynccontextmanager
async def both_sides(router: str) -> AsyncIterator[tuple[ZenohSession, RosNetwork]]:
    """On one router, each with a session of its own."""
    async with AsyncExitStack() as stack:
        networks = [
            await stack.enter_async_context(await RosNetwork.open(MeshSettings(connect=[router]))) for _ in range(2)
        ]
        ours = ZenohSession(networks[0], await asyncio.to_thread(KnownTypes))
        stack.push_async_callback(asyncio.to_thread, ours.close)
        yield ours, networks[1]
