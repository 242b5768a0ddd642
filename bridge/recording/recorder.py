"""Records a mesh: follows who is there, hears robots and headsets, and gives all of it to a sink. Asyncio."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import msgspec

from bridge.recording.arrived import Arrived
from bridge.recording.conditions import Condition, Event, stop_topic
from bridge.recording.disk import Entry, Sink, now_ns
from bridge.recording.doors import Doors
from bridge.recording.follower import RobotFollower
from bridge.recording.schema_source import Schemas
from bridge.recording.sent import SentCommands
from bridge.recording.streams import LOST_BEFORE, MESSAGES, NOTES, OFFERS, PRESENCE, Channel, robot_topic
from bridge.recording.traced import Traces
from bridge.recording.traffic import Said, Sent, Traffic
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError, Unreachable, WireError
from macs_zenoh.mesh import Sample
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.keyexpr import BROADCAST, GROUP, UNICAST
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.messages import ROS, decode_data
from macs_zenoh.protocol.name_patterns import matches
from macs_zenoh.protocol.robot_state import Offered, RobotStatus
from macs_zenoh.protocol.wire import Layout

log = logging.getLogger("macs.record")

STATUS_S = 1.0
"""How often a robot is asked how it is; its stop is heard at once."""
LAST_COUNTS_S = 1.5
"""How long a recording that ends waits for robots to tell how much they have put for it."""
BEFORE = "before_recorder"
HERE = ("topics_behind", "loop_behind", "topic_full", "missed", "bad_frame")
"""By these names is counted what has been lost on its way to a subscription and is known of."""
WITHOUT_STATUS_S = 30.0
"""The same of one that has not answered: an existing program."""


@dataclass(frozen=True)
class Wanted:
    """What is recorded.

    Attributes:
        robots: their ids; none: all.
        topics: patterns of topics' names; none: all.
        commands: what is sent to robots as commands and calls, what they answer and refuse, and the topics that they
            carry commands out on.
        headsets: plain messages between agents as well.
        traces: the way of one in so many messages, hop by hop; 0: of none.
    """

    robots: frozenset[int] = frozenset()
    topics: tuple[str, ...] = ()
    commands: bool = False
    headsets: bool = False
    traces: int = 0

    def robot(self, robot: int) -> bool:
        """Whether this robot is wanted."""
        return not self.robots or robot in self.robots

    def topic(self, topic: str) -> bool:
        """Whether this topic is wanted."""
        return not self.topics or any(matches(pattern, topic) for pattern in self.topics)


class Recorder:
    """One recording of a mesh, from `start` to `close`. ``on_trigger(name, about)`` hears of stops and dead-men."""

    def __init__(
        self,
        agent: Agent,
        sink: Sink,
        wanted: Wanted,
        on_trigger: Callable[[str, dict[str, Any]], None] = lambda name, about: None,
    ) -> None:
        self.agent = agent
        self.robots: dict[int, RobotFollower] = {}
        self._sink = sink
        self._wanted = wanted
        self._on_trigger = on_trigger
        self.schemas = Schemas(agent)
        self._json: dict[str, Channel] = {}
        self._doors = Doors(agent, self._put)
        self._commands = SentCommands(sink, self.schemas, self.robots, self._doors.token)
        self._traces: Traces | None = None
        self._watching: dict[int, asyncio.Task[None]] = {}
        self._asked: dict[int, asyncio.Event] = {}
        self._conditions: dict[int, Condition] = {}
        self._sessions: dict[int, tuple[str, int]] = {}
        """Of robots, when they were seen last."""
        self._subscribed: list[Any] = []
        layout = Layout(agent.mesh.settings.id_slots, agent.mesh.settings.group_slots)
        self._traffic = Traffic(layout, self._bad)
        self._bad_frames = 0
        self.demand: Callable[[int, str], bool] = lambda robot, topic: True
        """Whether a topic of a robot is wanted now; `RobotFollower.look_again` when that has changed."""
        self.on_offered: Callable[[int, Offered], None] = lambda robot, offered: None
        self._lost_before: Counter[str] = Counter()
        self._not_come = 0
        """Messages that robots have put for this recording, and that none of its subscriptions had."""
        self._before = 0
        """Of these, how many no counter here knows of."""

    def start(self) -> None:
        """Record from now on."""
        if self._wanted.commands or self._wanted.headsets:
            for key in self._keys():
                self._subscribed.append(self.agent.mesh.subscribe(key, self._heard))
        self.agent.on_presence(self._presence)
        self.agent.on_id(self._id_changed)
        if self._wanted.traces:
            self._traces = Traces(
                self.agent,
                self._wanted.traces,
                self.robots,
                commands=self._wanted.commands,
                wants=self.wants,
                put=self._put,
                note=self.note,
            )

    def close(self) -> None:
        """Hear no more; robots are told."""
        for task in self._watching.values():
            task.cancel()
        if self._traces is not None:
            self._traces.close()
        self._commands.close()
        self._doors.close()
        for subscription in self._subscribed:
            subscription.close()
        for follower in self.robots.values():
            follower.close()
        self.robots.clear()

    def wants(self, topic: str) -> bool:
        """Whether a topic of this name may be recorded."""
        return self._wanted.topic(topic)

    @property
    def topics(self) -> int:
        """How many topics are recorded now."""
        return sum(len(follower.subscriptions) for follower in self.robots.values())

    def losses(self) -> Counter[str]:
        """What was lost here since this was asked last, by name, before it could be recorded."""
        now = Counter(self.agent.drops) + Counter(self.agent.mesh.drops) + Counter(bad_frame=self._bad_frames)
        self._before = max(self._before, self._not_come - sum(now[name] for name in HERE))
        now[BEFORE] = self._before
        more = now - self._lost_before
        self._lost_before = now
        return more

    async def last_counts(self) -> None:
        """Wait a moment until robots have told how much they have put in all, so that what was lost of it is known."""
        await asyncio.gather(*(follower.last_counts(LAST_COUNTS_S) for follower in self.robots.values()))

    def _lost_on_the_way(self, robot: int, topic: str, more: int, arrived: Arrived) -> None:
        if arrived.lost == more:
            log.warning("%s: messages of it do not come here (logged once, counted)", robot_topic(robot, topic))
        self._not_come += more
        value = {"robot": robot, "topic": topic, "more": more, "in_all": arrived.lost}
        self._put(Event(LOST_BEFORE, value))

    def note(self, value: dict[str, Any]) -> None:
        """Something to know about the recording itself."""
        self._put(Event(NOTES, value))

    # -- who is there --------------------------------------------------------------------------------------------

    def _presence(self, agent: AgentInfo, online: bool) -> None:
        is_me = agent.zid == self.agent.mesh.zid
        about = {
            "agent": str(agent.key),
            "group": agent.group,
            "online": online,
            "session": agent.zid,
            "epoch": agent.epoch,
        }
        if is_me:
            about["recorder"] = True
        self._put(Event(PRESENCE, about, keep=f"{PRESENCE} {agent.key}"))
        (self._doors.came if online else self._doors.left)(agent)
        for follower in self.robots.values():
            follower.presence(agent, online)
        if agent.type != ROS or not self._wanted.robot(agent.id):
            return
        known = self._sessions.get(agent.id)
        if online:
            self._sessions[agent.id] = agent.session
        if online and agent.id not in self.robots:
            self._follow(agent.id)
        elif online:
            if known != agent.session:
                self._conditions[agent.id].began_again()
            self._asked[agent.id].set()
        elif not online:
            self.schemas.forget(agent.id)

    def _follow(self, robot: int) -> None:
        asked = self._asked[robot] = asyncio.Event()
        self._conditions[robot] = Condition(robot)
        self.robots[robot] = RobotFollower(
            self.agent,
            robot,
            self._sink,
            self.schemas,
            wants=lambda topic: self._wanted.topic(topic) and self.demand(robot, topic),
            carried_out=self._wanted.commands,
            on_note=self.note,
            on_stop_state=asked.set,
            on_offered=lambda offered: self.on_offered(robot, offered),
            on_lost=lambda topic, more, arrived: self._lost_on_the_way(robot, topic, more, arrived),
        )
        self._watching[robot] = asyncio.get_running_loop().create_task(self._watch(robot))

    def _id_changed(self, old: int, new: int) -> None:
        for follower in self.robots.values():
            follower.id_changed(old, new)

    async def _watch(self, robot: int) -> None:
        """Ask a robot how it is, for as long as this recording goes on."""
        condition, asked, offered = self._conditions[robot], self._asked[robot], None
        pause_s = STATUS_S
        while True:
            asked.clear()
            if (ROS, robot) in self.agent.directory:
                try:
                    answer = await self.agent.call(
                        ROS, robot, "status", self.robots[robot].asked_of_status(), timeout_s=5.0
                    )
                    status = decode_data(RobotStatus, answer, ANSWER_BYTES)
                    for event in condition.tell(status):
                        self._put(event)
                    self.robots[robot].stop_topic(stop_topic(status))
                    pause_s = STATUS_S
                except Unreachable as error:
                    log.debug("ros/%d does not say how it is: %s", robot, error)
                    pause_s = WITHOUT_STATUS_S
                except MacsError as error:
                    log.debug("ros/%d: %s", robot, error)
            if self.robots[robot].offered is not offered:
                offered = self.robots[robot].offered
                told = {"robot": robot, "offers": msgspec.to_builtins(offered)}
                self._put(Event(OFFERS, told, keep=f"{OFFERS} {robot}"))
            waiting = asyncio.ensure_future(asked.wait())
            await asyncio.wait([waiting], timeout=pause_s)
            waiting.cancel()

    # -- what is said --------------------------------------------------------------------------------------------

    def _keys(self) -> list[str]:
        """What is sent to robots and by robots, and what agents say to each other."""
        keys = [BROADCAST.every()] if self._wanted.headsets else []
        if not self._wanted.robots:
            to_robots = [UNICAST.every(type=ROS)]
            by_robots = [UNICAST.every(type="unity", from_type=ROS)]
        else:
            robots = sorted(self._wanted.robots)
            to_robots = [UNICAST.every(type=ROS, id=robot) for robot in robots]
            by_robots = [UNICAST.every(type="unity", from_type=ROS, from_id=robot) for robot in robots]
        others = [UNICAST.every(type="unity")] if self._wanted.headsets else []
        groups = GROUP.every() if self._wanted.headsets else GROUP.every(type=ROS)
        return [*keys, *to_robots, groups, *(others or by_robots)]

    def _heard(self, batch: Iterator[Sample]) -> None:
        for key, payload in batch:
            for what in self._traffic.read(key, payload):
                if isinstance(what, Sent):
                    self._commands.put(what, now_ns())
                elif self._wanted.headsets or what.channel != MESSAGES:
                    self._say(what)

    def _say(self, said: Said) -> None:
        self._put(Event(said.channel, said.value))

    def _bad(self, key: str, error: WireError) -> None:
        self._bad_frames += 1
        log.debug("a frame on %s cannot be read: %s", key, error)

    def _put(self, event: Event) -> None:
        channel = self._json.get(event.channel)
        if channel is None:
            channel = self._json[event.channel] = Channel(event.channel, metadata={"recorder": str(self.agent.key)})
        data = msgspec.json.encode(event.value)
        self._sink.put(Entry(channel, channel.next(len(data)), now_ns(), data, event.keep))
        if event.trigger:
            self._on_trigger(event.trigger, event.value)
