"""Commands that have waited on their way are not carried out: what is old is not what somebody wants now."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from macs_zenoh.agent import Agent
from tests.ros.driven import SETTINGS, STOPPED, Heard, driving, hear, may_command, send, send_bool, site, told
from tests.support.links import Link, counted
from tests.support.ros_peer import Peer
from tests.support.waiting import until


async def test_a_suspended_agent_does_not_make_up_for_lost_time(domain: int, peer: Peer, tmp_path: Path) -> None:
    """SIGSTOP for 1.6 s while commands come: what waited is counted and not carried out, but for the newest at most,
    and what comes afterwards is."""
    heard = await hear(peer)
    async with site(domain, tmp_path) as place, place.robot() as robot, place.headset() as driver:
        await may_command(driver, 1)
        async with driving(driver, 1, hz=20):
            await until(lambda: heard.last == 0.5)
            robot.send_signal(signal.SIGSTOP)
            try:
                await asyncio.sleep(0.2)
                before = len(heard.values)
                for number in range(14):
                    send(driver, 1, 100.0 + number)
                    await asyncio.sleep(0.1)
            finally:
                robot.send_signal(signal.SIGCONT)
            await until(lambda: len([v for _, v in heard.values[before:] if v == 0.5]) > 5)
        old = [value for _, value in heard.values[before:] if value >= 100]
        assert len(old) <= 1, old
        assert (await told(driver, 1))["drops"]["too_old"] >= 13


@asynccontextmanager
async def behind_a_link(
    domain: int, tmp_path: Path, settings: str = SETTINGS.format(deadman_s=0.5)
) -> AsyncIterator[tuple[Link, Agent]]:
    """The link of a robot to its router, and who may drive it."""
    async with (
        site(domain, tmp_path, settings) as place,
        counted(place.router.endpoint) as link,
        place.robot(router=link.endpoint),
        place.headset() as driver,
    ):
        await may_command(driver, 1)
        yield link, driver


@asynccontextmanager
async def held_while_driving(link: Link, driver: Agent, heard: Heard) -> AsyncIterator[None]:
    """The robot is driven all the time, and its link stands still from here on."""
    async with driving(driver, 1, hz=20):
        await until(lambda: heard.last == 0.5)
        link.hold_down()
        await asyncio.sleep(0.1)
        yield


async def test_a_link_that_stood_still_brings_no_old_commands(domain: int, peer: Peer, tmp_path: Path) -> None:
    """The same where the network between router and robot stood still, and a stop that waited there still stops."""
    heard = await hear(peer)
    async with behind_a_link(domain, tmp_path) as (link, driver), held_while_driving(link, driver, heard):
        before = len(heard.values)
        for number in range(15):
            send(driver, 1, 100.0 + number)
            await asyncio.sleep(0.1)
        link.release()
        await until(lambda: len([v for _, v in heard.values[before:] if v == 0.5]) > 5)
        assert len([v for _, v in heard.values[before:] if v >= 100]) <= 1
        link.hold_down()
        send_bool(driver, 1, True)
        await asyncio.sleep(1.0)
        link.release()
        await until(lambda: heard.last == STOPPED)
        assert (await told(driver, 1))["stopped"]


async def test_who_lets_go_while_the_link_stands_still_is_heard(domain: int, peer: Peer, tmp_path: Path) -> None:
    """The zero is as old as what was said before it and nobody says it again: it alone is carried out, or a robot
    without a dead-man would drive on."""
    heard = await hear(peer)
    async with behind_a_link(domain, tmp_path, settings="") as (link, driver):
        async with held_while_driving(link, driver, heard):
            pass
        for number in range(15):
            send(driver, 1, 100.0 + number)
            await asyncio.sleep(0.1)
        send(driver, 1, 0.0)
        await asyncio.sleep(1.2)
        assert heard.last == 0.5
        link.release()
        await until(lambda: heard.last == 0.0)
        assert not [value for _, value in heard.values if value >= 100]
        assert (await told(driver, 1))["drops"]["too_old"] >= 10
