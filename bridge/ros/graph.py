"""What a robot offers: its topics, services and actions, without our own, without ROS's plumbing and what is hidden.

ROS tells nobody in Python when its graph changes, so `Offers` looks once a second; a look costs well under a
millisecond as long as nothing has changed.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial

from bridge.ros import qos
from bridge.ros.interface import PublishStream, Registrant, Robot
from bridge.ros.rules import Rules
from bridge.ros.side import NamesAndTypes, Side
from bridge.ros.stream import StreamFraming
from macs_zenoh.errors import MacsError, WireError
from macs_zenoh.protocol.messages import ROS, FunctionalityRequest, Metadata, decode_data, encode_data
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import FollowRequest, Offered, TopicQos

log = logging.getLogger("macs.ros")

NOTHING: Mapping[str, str] = {}
PLUMBING_TOPICS = frozenset({"/rosout", "/parameter_events"})
PLUMBING_PACKAGES = ("rcl_interfaces/", "type_description_interfaces/", "lifecycle_msgs/")
"""Every ROS node brings services of these types; they are its parameters and states, not what the robot does."""

OFFERS_STREAM = "_offers"
"""Node of the robot's stream that carries `Offered` as JSON whenever it changes."""
LOOK_S = 1.0
FRESH_S = 0.05
"""So long what the graph was read to be is given to others that ask."""
SETTLE_LOOKS = 3
"""So many looks after a change read everything: ROS knows a topic before it knows whose it is."""
FOLLOWERS = 4096
"""Agents that are told of changes; of more, those that asked last."""

SEND_GOAL = "/_action/send_goal"
"""What the goal service of an action is called, after the action; its type is the action's with ``_SendGoal``."""


def offers(side: Side, rules: Rules | None = None, made: Mapping[str, str] = NOTHING) -> Offered:
    """The graph around our node now: what others subscribe, publish and serve, as far as ``rules`` expose it, and what
    our node makes for others, by name and type.

    Each name with its type (``geometry_msgs/msg/Twist``); the first by alphabet where a topic has several. To be
    called in the ROS thread.
    """
    rules = rules or Rules()
    subscribers, publishers, services = side.found()
    publishers = {**dict(made), **publishers}
    actions = {
        name.removesuffix(SEND_GOAL): of_type.removesuffix("_SendGoal")
        for name, of_type in services.items()
        if name.endswith(SEND_GOAL)
    }

    def visible(found: dict[str, str]) -> dict[str, str]:
        return {
            name: of_type
            for name, of_type in sorted(found.items())
            if rules.exposes(name) and not _is_plumbing(name, of_type)
        }

    subscribers, publishers = visible(subscribers), visible(publishers)
    return Offered(
        subscribers,
        publishers,
        visible(services),
        visible(actions),
        {topic: _qos_of(side, topic) for topic in sorted({*subscribers, *publishers})},
    )


def _is_plumbing(name: str, of_type: str) -> bool:
    return name in PLUMBING_TOPICS or _is_hidden(name) or of_type.startswith(PLUMBING_PACKAGES)


def _is_hidden(name: str) -> bool:
    """As ROS's own tools hide it."""
    return any(level.startswith("_") for level in name.split("/"))


def _qos_of(side: Side, topic: str) -> TopicQos:
    publishers = [publisher.qos for publisher in side.publishers(topic)]
    if publishers:
        profile = qos.for_subscription(publishers, 1)
    else:
        subscriptions = [subscription.qos for subscription in side.subscriptions(topic)]
        profile = qos.for_publisher(subscriptions, 1, latched=False)
    return TopicQos(profile.reliability.name.lower(), profile.durability.name.lower())


class Offers:
    """What the robot offers, for those who ask and for those who follow its changes. Belongs to the loop."""

    def __init__(
        self,
        robot: Robot,
        publish_stream: PublishStream,
        on_graph: Callable[[NamesAndTypes, NamesAndTypes], None] = lambda topics, services: None,
    ) -> None:
        """``on_graph`` is called in the ROS thread with topics and services, when they have changed."""
        self._robot = robot
        self._publish_stream = publish_stream
        self._on_graph = on_graph
        self._followers: dict[Registrant, int] = {}
        self._graph: tuple[NamesAndTypes, NamesAndTypes] | None = None
        self._last = Offered()
        self._read: asyncio.Task[Offered] | None = None
        self._read_at = 0.0
        self._frame = StreamFraming(
            Metadata(ROS, robot.agent_id, node_name=OFFERS_STREAM, message_manager=FunctionalityRequest.manager),
            [],
            robot.layout,
        )
        self._looking = asyncio.get_running_loop().create_task(self._look())

    async def now(self) -> Offered:
        """What it offers now. Whoever asks while others do gets their answer: it takes the ROS thread some time."""
        loop = asyncio.get_running_loop()
        if self._read is None or (self._read.done() and loop.time() > self._read_at + FRESH_S):
            session = self._robot.session
            self._read = loop.create_task(session.run(lambda: offers(session, self._robot.rules, self._robot.made)))
            self._read_at = loop.time()
        return await asyncio.shield(self._read)

    def follow(self, agent: Registrant, request: Message) -> None:
        """Tell this agent of every change from now on, if its request asks for that."""
        with suppress(WireError):
            if request.data and decode_data(FollowRequest, request.data).follow:
                self._followers.pop(agent, None)
                if len(self._followers) >= FOLLOWERS:  # one that was never seen is not seen to leave, either
                    del self._followers[next(iter(self._followers))]
                self._followers[agent] = request.metadata.request_id

    def forget(self, agent: Registrant) -> None:
        """An agent left."""
        self._followers.pop(agent, None)

    def close(self) -> None:
        """Stop looking."""
        self._looking.cancel()
        if self._read is not None:
            self._read.cancel()

    async def _look(self) -> None:
        side = self._robot.session
        looks = 0
        while True:
            try:
                graph = await side.run(lambda: (side.topics(), side.services()))
                if graph != self._graph:
                    self._graph, looks = graph, SETTLE_LOOKS
                    await self._robot.session.run(partial(self._on_graph, *graph))
                if looks:
                    looks -= 1
                    await self._tell(await self.now())
            except MacsError as error:
                log.debug("the graph cannot be read: %s", error)
                return
            await asyncio.sleep(LOOK_S)

    async def _tell(self, offered: Offered) -> None:
        if offered == self._last:
            return
        self._last = offered
        data = encode_data(offered)
        self._publish_stream(OFFERS_STREAM, self._frame(data))
        for agent, request_id in self._followers.items():
            metadata = Metadata(request_id=request_id, message_manager=FunctionalityRequest.manager)
            self._robot.send(agent, metadata, data)
