"""What `macs top` and `macs watch` share: they look at a mesh, which they do not join."""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

from msgspec import structs

from bridge.cli import named, options, robots
from bridge.settings import Settings
from macs_zenoh.protocol.agent_id import AgentId

if TYPE_CHECKING:
    from bridge.top.events import Event
    from bridge.top.observer import Observer


def add_options(parser: argparse.ArgumentParser) -> None:
    """How long to wait, who asks, and where the router is."""
    parser.add_argument("--wait", type=named.positive, default=5.0, metavar="S", help="for a router (default: 5)")
    options.add_as_option(parser)
    options.add_mesh_options(parser)


@asynccontextmanager
async def observed(
    settings: Settings, caller: AgentId, wait_s: float, on_events: Callable[[list[Event]], None]
) -> AsyncIterator[tuple[Observer, asyncio.Future[None]]]:
    """Somebody who has looked around and goes on looking until the end of the block, and what that comes to, which has
    an end only when it fails. Raises Unreachable when no router answers in time."""
    from bridge.top.observer import Observer

    async with AsyncExitStack() as stack:
        mesh = await stack.enter_async_context(robots.session(settings.mesh, timeout_s=wait_s))
        admin = mesh
        if settings.mesh.namespace:
            outside = structs.replace(settings.mesh, namespace=None)
            admin = await stack.enter_async_context(robots.session(outside, timeout_s=wait_s))
        observer = Observer(mesh, robots.Operator(mesh, caller, wait_s), on_events, admin)
        stack.callback(observer.close)
        await observer.begin()
        looking = asyncio.ensure_future(observer.run())
        stack.callback(looking.cancel)
        yield observer, looking
