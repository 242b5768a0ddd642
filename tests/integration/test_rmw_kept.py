"""A latched, reliable topic of a robot that runs rmw_zenoh, over the death of the router: nothing is lost."""

from __future__ import annotations

import asyncio
import signal
import struct
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import NamedTuple

import pytest

from bridge.headset.client import Headset
from bridge.headset.nodes import Subscription
from macs_zenoh import ros
from tests.support.programs import Program
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)

INT = "std_msgs/Int64"
FEW, MANY = 600, 10_000
SETTINGS = """
[[rmw_zenoh.robots]]
id = 7

[[robot.rules]]
match = "/log"
cache = 10000
"""
HELD = ros.Qos(depth=10_000, durability=ros.Durability.TRANSIENT_LOCAL)


def numbered(number: int) -> bytes:
    """A std_msgs/Int64."""
    return b"\0\1\0\0" + struct.pack("<q", number)


class Site(NamedTuple):
    """A router; on it `macs rmw-zenoh`, a gateway with a headset, and a node of robot 7's."""

    router: Router
    gateway: Program
    headset: Headset
    node: ros.Node


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    settings = tmp_path / "robots.toml"
    settings.write_text(SETTINGS, encoding="utf-8")
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        router = await enter(Router())
        await enter(Program("rmw-zenoh", "--settings", str(settings), "-e", router.endpoint))
        gateway = await enter(Program("gateway", "--port", "0", "-e", router.endpoint))
        node = await enter(ros.node("logger", connect=[router.endpoint]))
        headset = await enter(await Headset.connect("127.0.0.1", gateway.port))
        yield Site(router, gateway, headset, node)


async def restarted(router: Router) -> None:
    """Kill -9, and back after a second."""
    await router.stop(signal.SIGKILL)
    await asyncio.sleep(1)
    await router.start()


def take(messages: Subscription, into: list[int]) -> asyncio.Task[None]:
    """The numbers of all messages, from now on."""

    async def listen() -> None:
        async for message in messages:
            into.append(struct.unpack("<q", bytes(message.data)[4:12])[0])

    return asyncio.create_task(listen())


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.soak)])
async def test_from_the_robot(site: Site, count: int) -> None:
    """The router is killed while the robot publishes, and is back after a second: a headset has each message once, in
    order. One that comes later has the latest that are held."""
    log = site.node.publisher("/log", INT, qos=HELD)
    heard: list[int] = []
    listening = take(await site.headset.subscribe("/log", INT, agents=[7], buffer_size=MANY), heard)
    log.publish(numbered(0))
    await until(lambda: heard, PATIENCE_S)
    restarting = None
    for number in range(1, count):
        log.publish(numbered(number))
        if number == count // 3:
            restarting = asyncio.create_task(restarted(site.router))
        await asyncio.sleep(0.001)
    assert restarting is not None
    await restarting
    await until(lambda: len(heard) >= count, PATIENCE_S)
    assert heard == list(range(count))
    late: list[int] = []
    async with await Headset.connect("127.0.0.1", site.gateway.port) as other:
        held = min(count, 1000)
        taking = take(await other.subscribe("/log", INT, agents=[7], buffer_size=held), late)
        await until(lambda: len(late) >= held, PATIENCE_S)
        assert late == list(range(count - held, count))
        taking.cancel()
    listening.cancel()


async def test_a_robot_whose_nodes_do_not_come_back(site: Site) -> None:
    """It is offline when the router is back, and online with its registrations as soon as its nodes are."""
    log = site.node.publisher("/log", INT, qos=HELD)
    heard: list[int] = []
    listening = take(await site.headset.subscribe("/log", INT, agents=[7]), heard)
    log.publish(numbered(0))
    await until(lambda: heard, PATIENCE_S)
    await site.router.stop(signal.SIGKILL)
    site.node.close()
    await site.router.start()

    async def online() -> bool:
        return 7 in (await site.headset.online()).ros_agent_ids

    async def offline() -> bool:
        return not await online()

    await until(offline, PATIENCE_S)
    async with ros.node("logger", connect=[site.router.endpoint]) as node:
        again = node.publisher("/log", INT, qos=HELD)
        await until(online, PATIENCE_S)

        def comes() -> bool:
            again.publish(numbered(1))
            return heard[-1] == 1

        await until(comes, PATIENCE_S, every_s=0.05)
    listening.cancel()


async def test_a_router_of_the_robot_s_own(tmp_path: Path) -> None:
    """Where the nodes have another router than the mesh, and it is killed, the robot is offline while it is away; the
    agent that had registered hears it again, and each message once."""
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        own, mesh = await enter(Router()), await enter(Router())
        settings = tmp_path / "robots.toml"
        settings.write_text(f'[rmw_zenoh]\nconnect = ["{own.endpoint}"]\n{SETTINGS}', encoding="utf-8")
        await enter(Program("rmw-zenoh", "--settings", str(settings), "-e", mesh.endpoint))
        gateway = await enter(Program("gateway", "--port", "0", "-e", mesh.endpoint))
        headset = await enter(await Headset.connect("127.0.0.1", gateway.port))
        node = await enter(ros.node("logger", connect=[own.endpoint]))
        log = node.publisher("/log", INT, qos=HELD)
        heard: list[int] = []
        listening = take(await headset.subscribe("/log", INT, agents=[7], buffer_size=MANY), heard)
        log.publish(numbered(0))
        await until(lambda: heard, PATIENCE_S)

        async def online() -> bool:
            return 7 in (await headset.online()).ros_agent_ids

        async def offline() -> bool:
            return not await online()

        await own.stop(signal.SIGKILL)
        await until(offline, PATIENCE_S)
        for number in range(1, 50):
            log.publish(numbered(number))
        await own.start()
        await until(online, PATIENCE_S)
        await until(lambda: heard[-1:] == [49], PATIENCE_S)
        assert heard == list(range(50))
        listening.cancel()
