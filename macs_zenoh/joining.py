"""How a program becomes an agent on the mesh: with a type, an id and a group. Asyncio.

::

    async with macs_zenoh.join("ros", id=7, group=3, connect=["tcp/127.0.0.1:7447"]) as agent:
        agent.send(b"hello", to="unity", ids=[256])
        async for message in agent:
            print(message.sender_type, message.sender_id, message.data)
"""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager

from .agent import Agent
from .config import MeshSettings, TrafficRule
from .errors import OutOfRange
from .mesh import Mesh
from .protocol.guard import Guard
from .protocol.keyexpr import type_number
from .sections import changed

log = logging.getLogger("macs.agent")


@asynccontextmanager
async def join(
    agent_type: str | int,
    *,
    id: int | None = None,  # noqa: A002 - what everybody calls it
    group: int = 0,
    connect: Sequence[str] = (),
    settings: MeshSettings | None = None,
    traffic: Sequence[TrafficRule] = (),
    guard: Guard | None = None,
    on_waiting: Callable[[str], None] | None = None,
) -> AsyncIterator[Agent]:
    """Join the mesh as an agent and leave it at the end of the block.

    Args:
        agent_type: ``"ros"``, ``"unity"`` or a number from 1 to 255.
        id: 1 to 65535, unique per type; None takes a free one.
        group: 1 to 255, or 0 for none.
        connect: router endpoints, e.g. ``["tcp/127.0.0.1:7447"]``; several give fail-over.
        settings: everything else about the connection; ``connect``, if given, replaces its endpoints.
        traffic: rules for what this agent sends, by key.
        guard: judges all that comes, before it can wait.
        on_waiting: called once with the endpoints while no router answers; it waits as long as it takes.

    Raises:
        UsageError: the id is taken or out of range, the type unknown.
        ConfigError: Zenoh does not accept the settings.
    """
    kind = type_number(agent_type)
    if not 0 <= group <= 255:
        raise OutOfRange("group", group, 0, 255)
    settings = settings or MeshSettings()
    if connect:
        settings = changed(settings, connect=list(connect))
    async with (
        await Mesh.open(settings, traffic=traffic, on_waiting=on_waiting) as mesh,
        joined(mesh, kind, id=id, group=group, guard=guard) as agent,
    ):
        yield agent


@asynccontextmanager
async def joined(
    mesh: Mesh,
    kind: int,
    *,
    id: int | None = None,  # noqa: A002
    group: int = 0,
    guard: Guard | None = None,
) -> AsyncIterator[Agent]:
    """The same on a session that is open already. Raises UsageError."""
    agent = Agent(mesh, kind, group, guard)
    try:
        await agent._join(id)
        log.info("joined as %s/%d%s", agent.type, agent.id, f" in group {group}" if group else "")
        yield agent
    finally:
        agent.close()
