"""What is lost of commands between a gateway and a robot: Zenoh tells nobody, so both count."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

import macs_zenoh
from bridge.gateway import Gateway, command_counts
from bridge.gateway.command_counts import CommandCounts
from bridge.headset.client import Headset
from macs_zenoh.mesh import Traffic
from macs_zenoh.protocol.came import Came
from macs_zenoh.protocol.guard import BEFORE_ROBOT, Guard, Limits
from macs_zenoh.protocol.keyexpr import UNICAST
from macs_zenoh.protocol.messages import ROS, UNITY, Metadata, NodeType
from macs_zenoh.protocol.robot_state import CommandCount
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message
from tests.integration.test_who_registers import agent as tcp_agent
from tests.support.given import Connect, StartGateway
from tests.support.links import counted
from tests.support.local import patient, router_apart
from tests.support.waiting import until

ROBOT, NODE, TYPE = 7, "nd__cmd_vel", "std_msgs/UInt8MultiArray"
SIZE, COMMANDS = 8000, 5000
"""40 MB: a link that stands still has room for a few."""


class Robot:
    """A robot agent on the mesh that counts which commands come, and the names of what it has lost."""

    def __init__(self, agent: macs_zenoh.Agent, guard: Guard) -> None:
        self.agent = agent
        self.guard = guard
        self.taken = 0
        self.others: list[str] = []
        guard.on_command = self._take
        guard.on_missing = agent.mesh.drops.note
        agent.on_message(lambda message: self.others.append(message.metadata.message_manager))

    def _take(self, _: object) -> None:
        self.taken += 1

    def came(self, headset: int) -> Came | None:
        """What has come of one headset."""
        return self.guard._came._of.get(UNICAST.of(type=ROS, id=ROBOT, from_type=UNITY, from_id=headset))


@asynccontextmanager
async def robot_on(router: str, *, counts: bool = True) -> AsyncIterator[Robot]:
    """A robot, which says that it counts."""
    guard = Guard(Limits(), MACS)
    async with macs_zenoh.join("ros", id=ROBOT, settings=patient(router), guard=guard) as agent:

        async def status(call: macs_zenoh.Call) -> bytes:
            return json.dumps({"ros_node": "/x", **({"counts_commands": True} if counts else {})}).encode()

        async def add(call: macs_zenoh.Call) -> bytes:
            return b""

        agent.serve("status", status)
        agent.serve("add_node", add)
        yield Robot(agent, guard)


def command(size: int = 12) -> bytes:
    """A frame."""
    metadata = Metadata(node_type=NodeType.PUBLISHER, node_name=NODE, data_exchange_type=TYPE)
    return encode_frame(ROS, [ROBOT], message=encode_message(metadata.encode(), b"\0\1\0\0" + bytes(size)))


@pytest.mark.megabytes
async def test_what_a_full_link_drops_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot's link stands still while somebody commands on: what has come and what is counted as lost on the way are
    together what was put."""
    monkeypatch.setattr(command_counts, "TELL_S", 0.05)
    async with (
        router_apart() as router,
        counted(router, buffer_bytes=65536) as link,
        robot_on(link.endpoint) as robot,
        macs_zenoh.join("unity", id=300, settings=patient(router)) as headset,
    ):
        await until(lambda: (ROS, ROBOT) in headset.directory)
        counts = CommandCounts(headset.mesh, headset.directory)
        key = UNICAST.of(type=ROS, id=ROBOT, from_type=UNITY, from_id=300)

        def put(size: int = 12) -> None:
            if headset.mesh.put(key, command(size), Traffic.COMMAND):
                counts.put(key)

        def began() -> bool:
            put()
            return (came := robot.came(300)) is not None and came.since is not None

        await until(began, every_s=0.05)
        came, counted_put = robot.came(300), counts._put[key]
        assert came is not None
        assert counted_put is not None
        link.hold_down()
        for _ in range(COMMANDS):
            put(SIZE)
            await asyncio.sleep(0)
        link.release()

        def settled() -> bool:
            if came.since == counted_put.since and counted_put.count - came.samples - came.lost == came.before:
                return came.lost > 0
            put()  # counts are dropped as well, while the link is full
            return False

        await until(settled, every_s=0.1)
        assert robot.agent.mesh.drops[BEFORE_ROBOT] == came.lost
        assert robot.taken
        assert CommandCount.manager not in robot.others
        counts.close()


async def drive(headset: Headset, done: Callable[[], object], robot: int = ROBOT) -> None:
    """Command until something is so."""
    publisher = await headset.advertise("/cmd_vel", TYPE, agents=[robot])

    async def driven() -> object:
        await publisher.publish(b"\0\1\0\0" + bytes(8))
        return done()

    await until(driven, every_s=0.02)


async def test_a_gateway_tells_robots_that_count(
    start_gateway: StartGateway, connect: Connect, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind the first command, and then from time to time; where nothing is lost nothing is counted, and another in
    the robot's place is asked anew."""
    monkeypatch.setattr(command_counts, "TELL_S", 0.05)
    gateway = await start_gateway()
    headset = await connect(gateway)
    for _ in range(2):
        async with robot_on(router) as robot:
            await until(lambda: (ROS, ROBOT) in gateway.directory)

            def told(robot: Robot = robot) -> bool:
                came = robot.came(headset.id)
                return came is not None and came.since is not None

            await drive(headset, told)
            taken = robot.taken
            await drive(headset, lambda robot=robot, taken=taken: robot.taken > taken + 20)
            await until(lambda: not gateway._forwarding._counts._put)  # told of the last
            assert robot.agent.mesh.drops.total() == 0
            assert robot.others == []
        await until(lambda: (ROS, ROBOT) not in gateway.directory)


async def test_who_does_not_count_is_told_nothing(
    start_gateway: StartGateway, connect: Connect, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot agent that does not say so, and a robot program behind another gateway: they get the commands, and
    nothing else."""
    monkeypatch.setattr(command_counts, "TELL_S", 0.02)
    near, far = await start_gateway(), await start_gateway()
    headset = await connect(near)
    async with robot_on(router, counts=False) as robot, tcp_agent(far, ROS) as program:
        await until(lambda: {(ROS, ROBOT), (ROS, program.id)} <= {each.key for each in near.directory.of_type(ROS)})
        await drive(headset, lambda: robot.taken > 3)
        await drive(headset, lambda: commands(program.messages) > 3, program.id)
        await until(lambda: asked(near, ROBOT) == asked(near, program.id) == [float("inf")])
        await drive(headset, lambda seen=robot.taken: robot.taken > seen + 10)
        had = commands(program.messages)
        await drive(headset, lambda: commands(program.messages) > had + 10, program.id)
        assert robot.others == []
        assert CommandCount.manager not in {metadata.message_manager for metadata, _ in program.messages}


def commands(messages: list[tuple[Metadata, bytes]]) -> int:
    """How many of these are commands."""
    return sum(metadata.node_name == NODE and not metadata.message_manager for metadata, _ in messages)


def asked(gateway: Gateway, robot: int) -> list[float]:
    """What a gateway knows of a robot."""
    return list(gateway._forwarding._counts._known._robots.get(robot, {}).values())
