"""The link between two of our routers, lost and back before Zenoh notices: they notice, and mend it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass

import pytest

import macs_zenoh
from macs_zenoh.agent import Agent
from tests.support.links import Link, counted
from tests.support.programs import Program, free_port
from tests.support.waiting import until


@dataclass
class Sites:
    """Two routers with an agent each, and the link between them."""

    routers: list[Program]
    link: Link
    agents: list[Agent]

    def meet(self) -> bool:
        """Whether each agent sees the other."""
        one, other = self.agents
        return (other.type_number, other.id) in one.directory and (one.type_number, one.id) in other.directory

    def mended(self) -> int:
        """How often routers have started again."""
        return sum("starting again" in line for router in self.routers for line in router.log)


@pytest.fixture
async def sites() -> AsyncIterator[Sites]:
    async with AsyncExitStack() as stack:
        endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
        a = await stack.enter_async_context(Program("router", "-l", endpoints[0]))
        link = await stack.enter_async_context(counted(endpoints[0]))
        b = await stack.enter_async_context(Program("router", "-l", endpoints[1], "-e", link.endpoint))
        agents = [
            await stack.enter_async_context(macs_zenoh.join("9", id=60001 + number, connect=[endpoint]))
            for number, endpoint in enumerate(endpoints)
        ]
        sites = Sites([a, b], link, agents)
        await until(sites.meet)
        yield sites


async def test_a_link_that_flaps_carries_again(sites: Sites) -> None:
    """Whatever the flapping does to Zenoh, in the end all see each other, without anybody's help."""
    await asyncio.sleep(2)  # until both routers have heard of each other
    for number in range(12):
        for _ in range(1 + number % 3):
            sites.link.cut()
            sites.link.mend()
            await asyncio.sleep(0.02 * (1 + number % 5))
        await asyncio.sleep(2.5)  # an agent counts as online for 2 s after its router has lost it
        await until(sites.meet)
        if sites.mended():
            break
    await asyncio.sleep(2.5)
    await until(sites.meet)
    assert sites.mended() <= 2, "once each is enough"


async def test_a_link_that_is_lost_and_back_disturbs_nobody(sites: Sites) -> None:
    """A link that Zenoh restores by itself is left to it."""
    await asyncio.sleep(2)
    sites.link.cut()
    await until(lambda: not sites.meet())
    await asyncio.sleep(0.5)
    sites.link.mend()
    await until(sites.meet)
    await asyncio.sleep(2)
    assert sites.mended() == 0
