"""A recording that is played, as a program. Asyncio."""

from __future__ import annotations

import asyncio
import logging
import math
import sys
import time
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import macs_zenoh
from bridge.recording.mcap_records import ChannelRecord, Message
from bridge.replay.commands import LATE_S, Commands
from bridge.replay.player import Player
from bridge.replay.recorded import RecordedRobot, RecordedTopic, recorded_robots
from bridge.replay.robot import ReplayedRobot
from bridge.replay.tcp_robot import TcpRobot
from bridge.replay.timeline import Timeline
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError, UsageError
from macs_zenoh.protocol.keyexpr import type_name
from macs_zenoh.protocol.name_patterns import matches

log = logging.getLogger("macs.replay")

SETTLE_S = 1.0
"""How long headsets that wait for a robot have to register before the first message is played."""
SWITCH_S = 0.0005
"""So soon Python's threads take turns here: the player must not wait while a chunk is read."""

Put = Callable[[int, RecordedTopic, bytes], None]
"""Gives a message of a recorded robot's topic away, in the player's thread."""


@dataclass(frozen=True)
class Order:
    """What to play and where to.

    Attributes:
        path: the recording.
        to: ``mesh``, ``gateway`` or ``ros``.
        place: host and port of a gateway.
        robots: recorded ids; none: all.
        names: as which robot each is played, where not as itself.
        topics: patterns; none: all.
        own_names: the recorded robot whose topics keep their names in ROS, where they may move one; 0: none's do.
        commands_to: the robot to play commands to; 0: none are.
        sender: the headset whose commands are played, as ``unity/256``; empty: the only one's.
        agent: who plays them, if not any free headset's id.
    """

    path: Path
    to: str = "mesh"
    place: tuple[str, int] = ("", 0)
    robots: frozenset[int] = frozenset()
    names: Mapping[int, int] = field(default_factory=dict)
    topics: tuple[str, ...] = ()
    rate: float = 1.0
    loop: bool = False
    start_s: float = 0.0
    own_names: int = 0
    commands_to: int = 0
    sender: str = ""
    agent: tuple[int, int] | None = None

    def wants(self, topic: str) -> bool:
        """Whether a topic is played."""
        return not self.topics or any(matches(pattern, topic) for pattern in self.topics)

    def timeline(self, wanted: Callable[[ChannelRecord], bool]) -> Timeline:
        """The recording from where it begins."""
        return Timeline(self.path, wanted, start_s=self.start_s, rate=self.rate, loop=self.loop)


@dataclass(frozen=True)
class Played:
    """What became of it."""

    messages: int
    late_p99_s: float
    refused: Mapping[str, int]
    lost: int = 0
    left_out: int = 0
    """Commands that were due too long ago."""


async def replay(
    order: Order, mesh: MeshSettings, *, on_waiting: Callable[[str], None], on_ready: Callable[[str], None]
) -> Played:
    """Play it to its end, or until cancelled; then nothing of it is left anywhere.

    Raises BadBag, ConfigError, UsageError: there is nothing to play, or a robot of that id is online; Unreachable.
    """
    sys.setswitchinterval(SWITCH_S)
    if order.commands_to:
        return await _commands(order, mesh, on_waiting, on_ready)
    robots = recorded_robots(order.path, order.wants, order.start_s)
    robots = {number: robot for number, robot in robots.items() if not order.robots or number in order.robots}
    if not robots:
        raise UsageError(f"{order.path} has no topics of such robots")
    by_channel = {
        channel: (robot.id, topic)
        for robot in robots.values()
        for topic in robot.topics.values()
        for channel in topic.channels
    }
    lost: list[TcpRobot] = []
    async with _target(order, mesh, robots, on_waiting, lost) as (put, ended):
        names = ", ".join(str(order.names.get(number, number)) for number in sorted(robots))
        on_ready(f"playing {order.path} as robot{'s' if len(robots) > 1 else ''} {names} to {order.to}")

        def play(message: Message) -> None:
            put(*by_channel[message.channel], message.data)

        player = await _played(order.timeline(lambda channel: channel.id in by_channel), play, ended)
    return Played(player.played, player.late(0.99), {}, sum(robot.lost for robot in lost))


async def _played(
    timeline: Timeline, play: Callable[[Message], None], ended: asyncio.Event, max_late_s: float = math.inf
) -> Player:
    """Play a timeline to its end, or until the place that it is played to ends. Raises what reading it raises."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[object] = loop.create_future()

    def settle(error: MacsError | None) -> None:
        if not done.done():
            done.set_result(None) if error is None else done.set_exception(error)

    await asyncio.sleep(SETTLE_S)

    def end(error: MacsError | None) -> None:
        loop.call_soon_threadsafe(settle, error)

    player = Player(timeline, play, end, max_late_s)
    player.start()
    ending: asyncio.Future[object] = asyncio.ensure_future(ended.wait())
    try:
        await asyncio.wait([done, ending], return_when=asyncio.FIRST_COMPLETED)
        if done.done():
            done.result()
    finally:
        ending.cancel()
        await asyncio.to_thread(player.stop)
    return player


@asynccontextmanager
async def _target(
    order: Order,
    mesh: MeshSettings,
    robots: Mapping[int, RecordedRobot],
    on_waiting: Callable[[str], None],
    lost: list[TcpRobot],
) -> AsyncIterator[tuple[Put, asyncio.Event]]:
    """Where messages go, until the end of the block; the event is set when it takes no more."""
    ended = asyncio.Event()
    async with AsyncExitStack() as stack:
        if order.to == "ros":
            from bridge.ros.replayed import RosTarget

            if order.own_names and order.own_names not in robots:
                raise UsageError(
                    f"{order.path} has no topics of robot {order.own_names}, whose own names are to be used"
                )
            target = await asyncio.to_thread(
                RosTarget, robots, order.names, own_names=order.own_names, named=order.topics
            )
            stack.push_async_callback(asyncio.to_thread, target.close)
            await target.open()
            for topic, why in target.left_out.items():
                log.warning("%s is not played: %s", topic, why)
            yield target.put, ended
        elif order.to == "gateway":
            connected = {number: TcpRobot(robot) for number, robot in robots.items()}
            for robot in connected.values():
                await robot.connect(*order.place)
                stack.push_async_callback(robot.close)
                stack.callback(_watch(robot, ended).cancel)
                lost.append(robot)
            loop = asyncio.get_running_loop()

            def put(number: int, topic: RecordedTopic, cdr: bytes) -> None:
                loop.call_soon_threadsafe(connected[number].put, topic, cdr)

            yield put, ended
        else:
            replayed: dict[int, ReplayedRobot] = {}
            for number, robot_of_file in robots.items():
                agent = await stack.enter_async_context(
                    macs_zenoh.join(
                        "ros",
                        id=order.names.get(number, number),
                        group=robot_of_file.group,
                        settings=mesh,
                        on_waiting=on_waiting,
                    )
                )
                replayed[number] = ReplayedRobot(agent, robot_of_file)
                replayed[number].start()
            yield lambda number, topic, cdr: replayed[number].put(topic, cdr), ended
            for one in replayed.values():
                await one.agent.drain()


def _watch(robot: TcpRobot, ended: asyncio.Event) -> asyncio.Task[None]:
    async def wait() -> None:
        await robot.ended.wait()
        log.error("the gateway ended the connection: %s", robot.why)
        ended.set()

    return asyncio.create_task(wait())


async def _commands(
    order: Order, mesh: MeshSettings, on_waiting: Callable[[str], None], on_ready: Callable[[str], None]
) -> Played:
    recorded = next((old for old, new in order.names.items() if new == order.commands_to), order.commands_to)
    commands = Commands(order.path, recorded, order.commands_to, order.wants, order.sender)
    kind, number = order.agent or (2, 0)
    async with macs_zenoh.join(type_name(kind), id=number or None, settings=mesh, on_waiting=on_waiting) as agent:
        await commands.open(agent)
        try:
            on_ready(f"sending commands of {order.path} to robot {order.commands_to}: {', '.join(commands.topics)}")
            loop = asyncio.get_running_loop()

            def play(message: Message) -> None:
                loop.call_soon_threadsafe(commands.put, message.channel, message.data, time.monotonic())

            player = await _played(order.timeline(commands.wants), play, commands.ended, LATE_S)
            await agent.drain()
            await commands.judged(agent)
        finally:
            commands.close()
    return Played(commands.sent, player.late(0.99), commands.refused, left_out=player.left_out + commands.late)
