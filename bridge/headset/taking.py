"""What is taken from a headset, one after the other, until it ends or robots refuse."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Coroutine
from typing import Any

from macs_zenoh.errors import Refused
from macs_zenoh.protocol.keyexpr import type_name

from .client import Headset
from .nodes import Incoming, Node, ServiceRequest


async def only_from(sender: str | None, messages: AsyncIterator[Incoming]) -> AsyncIterator[Incoming]:
    """The messages of one type of agents, or of the router; of everybody without ``sender``."""
    async for message in messages:
        name = "router" if message.sender_type is None else type_name(message.sender_type)
        if sender is None or name == sender:
            yield message


async def until_ended(headset: Headset, requests: asyncio.Queue[ServiceRequest]) -> AsyncIterator[ServiceRequest]:
    """The requests in a queue, until the headset ends."""
    loop = asyncio.get_running_loop()
    ended = loop.create_task(headset.wait_ended())
    next_one = loop.create_task(requests.get())
    try:
        while True:
            await asyncio.wait((next_one, ended), return_when=asyncio.FIRST_COMPLETED)
            if not next_one.done():
                return
            request = next_one.result()
            next_one = loop.create_task(requests.get())
            yield request
    finally:
        next_one.cancel()
        ended.cancel()


async def unless_refused(work: Coroutine[Any, Any, None], node: Node | None) -> None:
    """Do ``work`` until every robot has refused ``node``. Raises Refused then."""
    if node is None:
        await work
        return
    loop = asyncio.get_running_loop()
    working, refused = loop.create_task(work), loop.create_task(node.wait_refused())
    try:
        await asyncio.wait((working, refused), return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            working.result()
        else:
            reasons = "; ".join(f"robot {robot}: {why}" for robot, why in node.refusing().items())
            raise Refused(f"{node.spec.tos_name} was refused by {reasons}")
    finally:
        for task in (working, refused):
            task.cancel()
        await asyncio.gather(working, refused, return_exceptions=True)
