"""Robots as separate processes with ROS domains of their own, joined only by `macs router`."""

from __future__ import annotations

import array
import asyncio
import signal
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest
from as2_ca_msgs.msg import LocalGenericMessage
from std_msgs.msg import String

from bridge.awareness.client import GatewayClient
from tests.support.links import Link, counted
from tests.support.programs import Program, free_port, macs
from tests.support.ros_peer import Peer
from tests.support.waiting import get, until

LARGE = 10_000
"""Bytes of a message that would be noticed on a link."""


@dataclass
class Robot:
    """A gateway process, its link, and a module's node in its domain with a client."""

    name: str
    link: Link
    program: Program
    peer: Peer
    client: GatewayClient
    received: asyncio.Queue[tuple[str, str]] = field(default_factory=asyncio.Queue)
    undelivered: asyncio.Queue[tuple[str, str, str]] = field(default_factory=asyncio.Queue)

    def __post_init__(self) -> None:
        self.loop = asyncio.get_running_loop()

    def hear_undelivered(self, *told: str) -> None:
        """Called in the module's executor."""
        self.loop.call_soon_threadsafe(self.undelivered.put_nowait, told)

    async def takes(self, message_type: str) -> None:
        """Register a module for Strings of a type."""

        def callback(message: Any, sender: str) -> None:
            self.loop.call_soon_threadsafe(self.received.put_nowait, (message.data, sender))

        module = self.client.register_module(String, message_type, self.name, callback)
        assert await asyncio.to_thread(module.wait, 10)


@dataclass
class Fleet:
    """All robots and the router."""

    endpoint: str
    router: Program
    robots: list[Robot]


@asynccontextmanager
async def fleet(count: int, domain: int) -> AsyncIterator[Fleet]:
    """So many robots, whose modules take messages of type ``words``, and who see each other."""
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        router = await stack.enter_async_context(Program("router", "-l", endpoint))
        robots = []
        for number in range(count):
            link = await stack.enter_async_context(counted(endpoint))
            robot_domain = 101 + (5 * domain + number) % 100
            program = await stack.enter_async_context(
                Program(
                    *("awareness", "--name", f"drone{number}", "-e", link.endpoint),
                    env={"ROS_DOMAIN_ID": str(robot_domain)},
                )
            )
            peer = Peer(robot_domain, "module")
            stack.push_async_callback(asyncio.to_thread, peer.session.close)
            client = await peer.session.run(lambda peer=peer: GatewayClient(peer.session.node))
            robot = Robot(f"drone{number}", link, program, peer, client)
            client.on_undelivered(robot.hear_undelivered)
            robots.append(robot)
        await asyncio.gather(*(robot.takes("words") for robot in robots))
        for robot in robots:
            others = sorted(other.name for other in robots if other is not robot)
            await until(lambda robot=robot, others=others: robot.client.reachable("words") == others)
        yield Fleet(endpoint, router, robots)


@pytest.mark.parametrize("count", [2, 5])
async def test_robots_in_domains_of_their_own(domain: int, count: int) -> None:
    """By name a message reaches its receiver only, to all it reaches all others, and never its sender.

    On the links of robots that a message is not for there is none of its data.
    """
    async with fleet(count, domain) as all_of_them:
        first, second, *others = all_of_them.robots
        before = [robot.link.down_bytes for robot in all_of_them.robots]
        words = "x" * LARGE
        for number in range(20):
            first.client.send(String(data=f"{number} {words}"), "words", to=second.name)
        for number in range(20):
            assert await get(second.received) == (f"{number} {words}", "drone0")
        down = [robot.link.down_bytes - old for robot, old in zip(all_of_them.robots, before, strict=True)]
        assert down[1] > 20 * LARGE
        assert [bytes_ for n, bytes_ in enumerate(down) if n != 1 and bytes_ > LARGE] == []

        for robot in all_of_them.robots:
            robot.client.send(String(data=f"all from {robot.name}"), "words")
        for robot in all_of_them.robots:
            expected = {(f"all from {o.name}", o.name) for o in all_of_them.robots if o is not robot}
            assert {await get(robot.received) for _ in expected} == expected
        second.client.send(String(data="end"), "words", to="drone0")
        assert await get(first.received) == ("end", "drone1")
        assert all(robot.received.empty() for robot in [*all_of_them.robots, *others])
        listed = await macs("ls", "--json", "-e", all_of_them.endpoint)
        assert [(a["type"], a["id"], a["name"]) for a in listed] == [("ros", n + 1, f"drone{n}") for n in range(count)]


async def test_what_happens_to_an_unregistered_type(domain: int) -> None:
    """The sender's modules are told, the receiver warns once, and registered types still arrive."""
    async with fleet(2, domain) as two:
        first, second = two.robots
        out = await first.peer.publisher(LocalGenericMessage, "gateway_out", matched=1)
        for _ in range(3):
            out.publish(LocalGenericMessage(agent="drone1", type="pictures", data=array.array("B", b"x")))
            assert await get(first.undelivered) == ("drone1", "pictures", "not registered")
        first.client.send(String(data="still"), "words", to="drone1")
        assert await get(second.received) == ("still", "drone0")
        for robot, text in ((first, "'pictures' to 'drone1': not registered"), (second, "has registered 'pictures'")):
            await until(lambda robot=robot, text=text: any(text in line for line in robot.program.log))
            assert sum(text in line for line in robot.program.log) == 1


async def test_after_any_kill_they_talk_again(domain: int) -> None:
    """A gateway and the router are killed with -9 and started again: messages flow again, nobody registers by hand.

    While the receiver is gone, the sender's modules are told.
    """
    async with fleet(2, domain) as two:
        first, second = two.robots
        await second.program.stop(signal.SIGKILL)
        await until(lambda: not first.client.reachable())
        first.client.send(String(data="lost"), "words", to="drone1")
        assert await get(first.undelivered) == ("drone1", "words", "no such agent")
        await second.program.start()
        await talk_again(first, second)

        await two.router.stop(signal.SIGKILL)
        await until(lambda: not first.client.reachable())
        await two.router.start()
        await talk_again(first, second)
        await talk_again(second, first)


async def talk_again(sender: Robot, receiver: Robot) -> None:
    """Wait until the sender sees the receiver take words, and send one."""
    await until(lambda: sender.client.reachable("words") == [receiver.name])
    sender.client.send(String(data="again"), "words", to=receiver.name)
    assert await get(receiver.received) == ("again", sender.name)
