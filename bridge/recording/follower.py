"""The topics of one robot, as a recording hears them.

It registers as any headset does, so the robot's uplink carries one copy, whether a gateway has asked for it or not.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

from bridge.recording.arrived import Arrived
from bridge.recording.disk import Entry, Sink, now_ns
from bridge.recording.schema_source import Schemas
from bridge.recording.streams import Channel, robot_channel
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError, Refused, WireError
from macs_zenoh.mesh import Sample
from macs_zenoh.nodes import Nodes
from macs_zenoh.protocol.directory import AgentInfo, Change
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.messages import ROS, decode_data, encode_data, node_name
from macs_zenoh.protocol.offers import short_type
from macs_zenoh.protocol.robot_state import Offered, StatusRequest, StreamCount, TopicQos
from macs_zenoh.protocol.schemas import full_type
from macs_zenoh.protocol.wire import Layout, parse_frames
from macs_zenoh.timeouts import within
from macs_zenoh.topics import TopicMessage, TopicSubscription

log = logging.getLogger("macs.record")

OFFERS_STREAM = "_offers"
"""Where a robot says what it offers, whenever that changes."""
DEPTH = 200
"""Messages that the robot may hold for a recording, where it is the first to register."""
LARGE_DEPTH = 10
"""The same of types that are large."""
LARGE = ("Image", "PointCloud", "CompressedVideo", "OccupancyGrid", "Map")
AGAIN_S = 2.0
"""Pause between attempts where a robot does not say what it has."""
LOOK_S = 10.0
"""What a robot has is asked again so often: what it says of a change may get lost, or come before anybody listens."""
PATIENCE_S = 20.0
"""How long a registration may take."""
COUNTS_S = 5.0
"""How often a robot is asked how much it has put: each answer is a message of a topic more, on its link."""
ALL_AGAIN_S = 0.6
"""The same at the end; a robot tells it twice a second."""
NEW_COUNTS, ALL_COUNTS = (encode_data(StatusRequest(counts)) for counts in ("new", "all"))
"""What the verb ``status`` is asked besides."""
OnNote = Callable[[dict[str, object]], None]
OnLost = Callable[[str, int, Arrived], None]
"""Of a topic, how many more messages have not come, and how it is with the topic now."""


class RobotFollower:
    """Follows one robot while it is online. ``wants(topic)`` says which topics; ``carried_out``: also those that only
    others than the robot's nodes publish to, where its commands are seen as it carried them out."""

    def __init__(
        self,
        agent: Agent,
        robot: int,
        sink: Sink,
        schemas: Schemas,
        *,
        wants: Callable[[str], bool],
        carried_out: bool,
        on_note: OnNote,
        on_stop_state: Callable[[], None],
        on_offered: Callable[[Offered], None] = lambda offered: None,
        on_lost: OnLost = lambda topic, more, arrived: None,
    ) -> None:
        self.robot = robot
        self.offered = Offered()
        self.subscriptions: dict[str, TopicSubscription] = {}
        self.refused: dict[str, str] = {}
        self._agent = agent
        self._sink = sink
        self._schemas = schemas
        self._wants = wants
        self._carried_out = carried_out
        self._on_note = on_note
        self._on_stop_state = on_stop_state
        self._on_offered = on_offered
        self._on_lost = on_lost
        self._arrived: dict[str, Arrived] = {}
        """By topic."""
        self._counts_due = 0.0
        self._awaited: set[str] = set()
        """Topics of which the robot shall tell once more how much it has put."""
        self._all_told = asyncio.Event()
        self._layout = Layout(agent.mesh.settings.id_slots, agent.mesh.settings.group_slots)
        self._nodes = Nodes(agent, self._layout, patient=True, on_count=self._counted)
        self._following: dict[str, asyncio.Task[None]] = {}
        self._stop_topic = ""
        self._has_told = False
        """Whether it has said what it offers."""
        key = STREAM.of(type=ROS, id=robot, node=OFFERS_STREAM)
        self._stream = agent.mesh.subscribe(key, self._heard)
        self._asking = asyncio.get_running_loop().create_task(self._ask())

    def presence(self, agent: AgentInfo, online: bool) -> None:
        """Somebody came or left."""
        self._nodes.presence(Change(agent, online))

    def id_changed(self, old: int, new: int) -> None:
        """The recording has another id."""
        self._nodes.id_changed((self._agent.type_number, old), new)

    def asked_of_status(self) -> bytes:
        """What the verb ``status`` is asked besides: now and then, how much the robot has put. Before it has told any
        each time, so that it is known whether it does."""
        now = time.monotonic()
        if now < self._counts_due and any(arrived.told for arrived in self._arrived.values()):
            return b""
        self._counts_due = now + COUNTS_S
        return NEW_COUNTS

    async def last_counts(self, timeout_s: float) -> None:
        """Wait until the robot has told how much it has put of each topic, if it ever has."""
        self._awaited = {topic for topic, arrived in self._arrived.items() if arrived.told is not None}
        if not self._awaited:
            return
        self._all_told.clear()
        with suppress(MacsError, asyncio.TimeoutError):
            await within(self._ask_for_counts(timeout_s), timeout_s)

    async def _ask_for_counts(self, timeout_s: float) -> None:
        while not self._all_told.is_set():  # it may have been asked right before, or its word be lost
            await self._agent.call(ROS, self.robot, "status", ALL_COUNTS, timeout_s=timeout_s)
            with suppress(asyncio.TimeoutError):
                await within(self._all_told.wait(), ALL_AGAIN_S)

    def _counted(self, key: str, data: bytes) -> None:
        """The robot has told, behind all that it counts."""
        parsed = STREAM.parse(key)
        topic = self.topic_of(parsed.node) if parsed is not None else ""
        arrived = self._arrived.get(topic)
        if arrived is None:
            return
        try:
            more = arrived.count(decode_data(StreamCount, data))
        except WireError as error:
            log.debug("how much ros/%d has put of %s cannot be read: %s", self.robot, topic, error)
            return
        if more:
            self._on_lost(topic, more, arrived)
        self._awaited.discard(topic)
        if not self._awaited:
            self._all_told.set()

    def close(self) -> None:
        """Follow no more: the robot is told."""
        self._asking.cancel()
        for task in self._following.values():
            task.cancel()
        self._stream.close()
        for subscription in list(self.subscriptions.values()):
            subscription.close()
        self._nodes.close()

    def topic_of(self, node: str) -> str:
        """The topic or service behind the name of an interface node, as well as it can be known."""
        offered = self.offered
        for table in (offered.subscribers, offered.publishers, offered.services, offered.actions):
            for name in table:
                if node_name(name) == node:
                    return name
        return "/" + node.removeprefix("nd_").removeprefix("_")

    def stop_topic(self, topic: str) -> None:
        """The robot's emergency stop is on this topic: its state is heard at once."""
        if topic and topic != self._stop_topic:
            self._stop_topic = topic
            self._follow(topic, "std_msgs/msg/Bool", TopicQos("reliable", "transient_local"), self._on_stop_state)

    def look_again(self) -> None:
        """Other topics are wanted now: follow those, and leave those that are not any more."""
        self._take(self.offered)
        for topic in [topic for topic in self._following if topic != self._stop_topic and not self._wants(topic)]:
            self._following.pop(topic).cancel()
            subscription = self.subscriptions.pop(topic, None)
            if subscription is not None:
                subscription.close()
                self._arrived.pop(topic, None)

    def forget_offers(self) -> None:
        """It has left: whatever comes under its id has to tell what it offers."""
        self.offered, self._has_told = Offered(), False
        self._asking.cancel()
        self._asking = asyncio.get_running_loop().create_task(self._ask())

    # -- what it has ---------------------------------------------------------------------------------------------

    async def _ask(self) -> None:
        while True:
            try:
                answer = await self._agent.call(ROS, self.robot, "offers", timeout_s=PATIENCE_S)
                self._take(decode_data(Offered, answer, ANSWER_BYTES))
                self._has_told = True
            except MacsError as error:
                log.debug("ros/%d does not say what it offers: %s", self.robot, error)
            await asyncio.sleep(LOOK_S if self._has_told else AGAIN_S)

    def _heard(self, batch: Iterator[Sample]) -> None:
        for _, payload in batch:
            try:
                for frame in parse_frames(payload, self._layout):
                    self._take(decode_data(Offered, frame.body, ANSWER_BYTES))
            except WireError as error:
                log.warning("what ros/%d says that it offers cannot be read: %s", self.robot, error)

    def _take(self, offered: Offered) -> None:
        if self.offered != offered:
            self.offered = offered
            self._on_offered(offered)
        topics = dict(offered.publishers)
        if self._carried_out:
            topics = {**offered.subscribers, **topics}
        for topic, of_type in topics.items():
            if self._wants(topic):
                self._follow(topic, of_type, offered.qos.get(topic, TopicQos()))

    def _follow(self, topic: str, of_type: str, qos: TopicQos, on_message: Callable[[], None] | None = None) -> None:
        if topic in self._following:
            return
        loop = asyncio.get_running_loop()
        self._following[topic] = loop.create_task(self._subscribe(topic, of_type, qos, on_message))

    async def _subscribe(self, topic: str, of_type: str, qos: TopicQos, on_message: Callable[[], None] | None) -> None:
        try:
            schema = await self._schemas.of(self.robot, full_type(of_type))
            depth = LARGE_DEPTH if any(word in of_type for word in LARGE) else DEPTH
            subscription = await self._nodes.subscribe(topic, self.robot, (), short_type(of_type), depth, PATIENCE_S)
        except Refused as refusal:
            self._not_recorded(topic, refusal.reason)
            return
        except MacsError as error:
            self._not_recorded(topic, str(error))
            await asyncio.sleep(AGAIN_S)
            self._following.pop(topic, None)
            if not self._has_told or topic in {*self.offered.publishers, *self.offered.subscribers}:
                self._follow(topic, of_type, qos, on_message)
            return
        self.refused.pop(topic, None)
        self.subscriptions[topic] = subscription
        subscription.on_refused(lambda _, reason: self._not_recorded(topic, reason))
        channel = robot_channel(self.robot, topic, of_type, schema.text, schema.hash, qos)
        arrived = self._arrived[topic] = Arrived()
        subscription.on_message(self._taking(channel, arrived, on_message))

    def _taking(
        self, channel: Channel, arrived: Arrived, on_message: Callable[[], None] | None
    ) -> Callable[[TopicMessage], None]:
        put, keep = self._sink.put, channel.topic if channel.latched else ""

        def take(message: TopicMessage) -> None:
            data = message.data
            arrived.message()
            ago_s = time.monotonic() - message.received_s
            put(Entry(channel, channel.next(len(data)), now_ns() - int(ago_s * 1e9), data, keep))
            if on_message is not None:
                on_message()

        return take

    def _not_recorded(self, topic: str, reason: str) -> None:
        if self.refused.get(topic) != reason:
            self.refused[topic] = reason
            log.warning("/%d%s is not recorded: %s", self.robot, topic, reason)
            self._on_note({"robot": self.robot, "topic": topic, "not_recorded": reason})
