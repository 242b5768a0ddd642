"""Commands of a headset that tells when it made them, over a real gateway to a real robot, with a relay in between."""

from __future__ import annotations

import asyncio
import json
import random
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message

from bridge.headset.client import Headset
from bridge.headset.nodes import Publisher
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.keyexpr import LEASE, PING
from tests.ros.driven import Heard, hear
from tests.support.links import counted
from tests.support.local import patient
from tests.support.programs import Program, ended, free_port
from tests.support.relays import Relay, as_it_comes, relay
from tests.support.ros_peer import Peer
from tests.support.waiting import until

HZ = 400
REFUSED = ("too_old", "repeated", "out_of_order", "no_clock")
WAITS = "transport/link/tx/queue/congestion_control/drop/wait_before_drop:20000000"
"""In us. A link that is full, as on a machine that is too busy to send, drops commands by itself, and nobody can count
those: so here links wait, and whatever else happens to a command is accounted for."""
NUMBERS = [pytest.param(300), pytest.param(10_000, marks=pytest.mark.soak)]


def twist(x: float) -> bytes:
    value = Twist()
    value.linear.x = float(x)  # an int would be written as its bits
    return bytes(serialize_message(value))


@dataclass
class Site:
    """A headset behind a relay that drives, and what the robot's topic carries."""

    headset: Headset
    relay: Relay
    commands: Publisher
    heard: Heard
    mesh: Mesh
    gateway: str
    """Its session, as others see it."""
    before: Counter[str] = field(default_factory=Counter)
    """What was lost before the test began."""

    async def drops(self) -> Counter[str]:
        """What the robot has refused."""
        status: Any = json.loads(await self.headset.ask(1, "RobotStatus", timeout_s=30))
        return Counter({name: count for name, count in status["drops"].items() if name in REFUSED})

    async def lost(self) -> Counter[str]:
        """All that was lost or refused so far, by who counts it and its name there."""
        status: Any = json.loads(await self.headset.ask(1, "RobotStatus", timeout_s=30))
        said, told = ping.decode(await self.mesh.query(PING.of(zid=self.gateway), ping.AGENTS, timeout_s=60))
        lost = {"robot": status["drops"], "gateway": ping.decode_told(told).lost, "gateway's session": said.drops}
        return Counter({f"{who}: {name}": count for who, names in lost.items() for name, count in names.items()})

    async def accounted(self, sent: int) -> Counter[str]:
        """What became of so many commands that did not move the robot: with those that did they are all of them, each
        counted once, and there is nothing else."""
        await self.commands.publish(twist(0))  # passes always, and last
        await until(lambda: 0.0 in self.carried_out)
        moved = sum(value != 0 for value in self.carried_out)
        found: Counter[str] = Counter()

        async def all_counted() -> bool:
            found.clear()
            found.update(await self.lost() - self.before)
            return found.total() + moved >= sent

        try:
            await until(all_counted, every_s=0.3)  # who pings more often is not answered
        except AssertionError:
            raise AssertionError(f"of {sent} {moved} were carried out, and these counted: {dict(found)}") from None
        assert found.total() + moved == sent, found
        print(f"of {sent} commands {moved} moved the robot: {dict(found)}")
        return found

    async def drive(self, count: int, first: int = 1) -> None:
        """Command, each with its number, until the relay has met them all."""
        loop, met = asyncio.get_running_loop(), self.relay.commands
        began = loop.time()
        for number in range(count):
            await self.commands.publish(twist(first + number))
            await asyncio.sleep(began + (number + 1) / HZ - loop.time())
        await until(lambda: self.relay.commands >= met + count)

    @property
    def carried_out(self) -> list[float]:
        return [value for _, value in self.heard.values]


@asynccontextmanager
async def driven(peer: Peer, domain: int, path: Path, max_age_s: float, more: str = "") -> AsyncIterator[Site]:
    """Everything, and a clock that the robot knows. ``more``: of the robot's settings."""
    settings = path / "macs.toml"
    waits = f"[mesh]\noverrides = ['{WAITS}']\n"
    settings.write_text(f"{waits}[robot]\nmax_timed_command_age_s = {max_age_s}\n{more}")
    heard = await hear(peer, depth=20_000)
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        await stack.enter_async_context(Program("router", "-l", endpoint, "--cfg", WAITS))
        words = ("-e", endpoint, "--settings", str(settings))
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", *words))
        robot = Program("agent", "--id", "1", *words, env={"ROS_DOMAIN_ID": str(domain)})
        await stack.enter_async_context(robot)
        between = await stack.enter_async_context(relay(gateway.port))
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", between.port))
        mesh = await stack.enter_async_context(await Mesh.open(patient(endpoint)))
        yield await ready(headset, between, heard, mesh)


async def ready(headset: Headset, between: Relay, heard: Heard, mesh: Mesh) -> Site:
    async def is_online() -> bool:
        return 1 in (await headset.online(30)).ros_agent_ids

    await until(is_online)
    commands = await headset.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[1])
    assert await headset.tell_times([1], timeout_s=30) == {1}
    (lease,) = [LEASE.parse(key) for key in await mesh.tokens(LEASE.every(), timeout_s=60)]
    assert lease is not None
    site = Site(headset, between, commands, heard, mesh, lease.zid)

    async def arrives() -> bool:
        await commands.publish(twist(0))
        return bool(heard.values)

    await until(arrives, every_s=0.1)
    site.before = await site.lost()  # whatever was sent before this has come
    heard.forget()
    return site


@pytest.mark.parametrize("count", NUMBERS)
async def test_what_is_replayed_is_carried_out_once(count: int, domain: int, peer: Peer, tmp_path: Path) -> None:
    """Each command comes again, at once or later; none is carried out twice, every other one is counted, and the
    headset is told."""
    chance = random.Random(count)
    async with driven(peer, domain, tmp_path, 5.0) as site:
        site.relay.meddle = lambda frame: [(0.0, frame), (chance.choice((0.0, 0.01, 0.1)), frame)]
        await site.drive(count)
        await asyncio.sleep(0.2)  # the last repetitions
        site.relay.meddle = as_it_comes
        await site.accounted(2 * count)
        assert (await site.drops()).keys() & {"repeated", "out_of_order"}
        moved = [value for value in site.carried_out if value]
        assert moved == sorted(set(moved)), "none twice, nor behind a later one"
        assert len(moved) >= count / 2
        await until(lambda: site.commands.refusing())


@pytest.mark.parametrize("count", NUMBERS)
async def test_what_comes_300_ms_late_is_not_carried_out(count: int, domain: int, peer: Peer, tmp_path: Path) -> None:
    """None of them, and each is counted once; a velocity of zero that is as late is carried out."""
    async with driven(peer, domain, tmp_path, 0.2) as site:
        site.relay.meddle = lambda frame: [(0.3, frame)]
        await site.drive(count)
        await site.accounted(count)
        assert site.carried_out == [0.0]
        assert (await site.drops())["too_old"]


@pytest.mark.parametrize("count", NUMBERS)
async def test_what_comes_out_of_order_is_not_carried_out(count: int, domain: int, peer: Peer, tmp_path: Path) -> None:
    """Of four that come the other way round the first to come, which is the newest, is carried out; each other one is
    counted."""
    waiting: list[bytes] = []

    def reverse(frame: bytes) -> list[tuple[float, bytes]]:
        waiting.append(frame)
        if len(waiting) < 4:
            return []
        frames = [(0.0, each) for each in reversed(waiting)]
        waiting.clear()
        return frames

    async with driven(peer, domain, tmp_path, 5.0) as site:
        site.relay.meddle = reverse
        await site.drive(count)
        site.relay.meddle = as_it_comes
        await site.accounted(count)
        assert (await site.drops())["out_of_order"]
        moved = [value for value in site.carried_out if value]
        assert moved == sorted(set(moved)), "none behind a later one"
        assert len({(value - 1) // 4 for value in moved}) == len(moved) >= count // 8


async def test_a_way_that_is_slow_from_the_start_is_noticed(domain: int, peer: Peer, tmp_path: Path) -> None:
    """Behind the gateway everything takes 0.3 s, always: nothing that compares with how it usually is would notice. No
    command is carried out, a velocity of zero is."""
    heard = await hear(peer)
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        await stack.enter_async_context(Program("router", "-l", endpoint))
        link = await stack.enter_async_context(counted(endpoint, delay_s=0.3))
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", "-e", link.endpoint))
        robot = Program("agent", "--id", "1", "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)})
        await stack.enter_async_context(robot)
        between = await stack.enter_async_context(relay(gateway.port))
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", between.port))
        mesh = await stack.enter_async_context(await Mesh.open(patient(endpoint)))
        site = await ready(headset, between, heard, mesh)
        await site.drive(100)
        await site.commands.publish(twist(0))
        await until(lambda: 0.0 in site.carried_out)  # and all that was sent before it has come
        assert site.carried_out == [0.0]
        drops = await site.drops()
        assert drops["too_old"]  # the rest is the gateway's, which finds a pause in them
        assert set(drops) == {"too_old"}


async def test_a_client_that_lies_only_harms_itself(domain: int, peer: Peer, tmp_path: Path) -> None:
    """Who says that it is later or earlier at his place than it is: his commands are refused, or are as old as they
    are; another headset's are carried out all the while."""
    async with driven(peer, domain, tmp_path, 5.0) as site:
        honest = await Headset.connect("127.0.0.1", site.relay.port)
        async with honest:
            commands = await honest.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[1])
            assert await honest.tell_times([1], timeout_s=30) == {1}
            clock = site.headset.clock
            for wrong_s in (-20.0, 20.0):
                clock._began -= wrong_s
                clock._last = 0
                await site.commands.publish(twist(1))
                clock._began += wrong_s
                await commands.publish(twist(2))
                await until(lambda: 2.0 in site.carried_out)
                assert await site.drops()
                assert 1.0 not in site.carried_out
                site.heard.forget()


async def test_a_headset_on_the_command_line_tells_the_time(domain: int, peer: Peer, tmp_path: Path) -> None:
    """``macs headset pub --timed`` waits until the robot knows its clock, and what it sends is carried out."""
    async with driven(peer, domain, tmp_path, 5.0) as site:
        command = ("pub", "/cmd_vel", "geometry_msgs/Twist", '{"linear": {"x": 7}}', "--agents", "1")
        code, out, errors = await ended(
            "headset", f"127.0.0.1:{site.relay.port}", *command, "--timed", "--count", "3", "--rate", "20"
        )
        assert code == 0, errors
        assert json.loads(out) == {"topic": "/cmd_vel", "published": 3}
        await until(lambda: site.carried_out == [7.0] * 3)
        assert not (await site.drops()).total()
