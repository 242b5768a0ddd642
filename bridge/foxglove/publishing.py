"""What clients of a Foxglove server publish to robots: sent at once or not at all, since it may move them. Asyncio."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import suppress

from bridge.recording.streams import JSON, split_topic
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError
from macs_zenoh.topics import TopicPublisher

OLD_S = 0.2
"""What has waited longer for our loop is an old command: it is not sent."""
AGAIN_S = 2.0
"""Pause between two attempts to register what a client still publishes."""
TOPICS = 256
"""Of all clients together."""

Key = tuple[int, int]
"""A client and its channel."""


class _Topic:
    """One channel of a client."""

    def __init__(self, name: str, of_type: str, encoding: str) -> None:
        self.name = name
        self.type = of_type
        self.encoding = encoding
        self.publisher: TopicPublisher | None = None
        self.registering: asyncio.Task[None] | None = None
        self.tried_s = 0.0


class ClientTopics:
    """The channels of all clients. ``wants(robot, topic)``: whether they may publish there; ``tell(topic, why)`` is
    called for what is not sent."""

    def __init__(self, agent: Agent, wants: Callable[[int, str], bool], tell: Callable[[str, str], None]) -> None:
        self._agent = agent
        self._wants = wants
        self._tell = tell
        self._topics: dict[Key, _Topic] = {}

    def advertise(self, key: Key, name: str, of_type: str, encoding: str) -> None:
        """A client will publish: register with the robot now, so that no command has to wait for it."""
        self.unadvertise(key)
        named = split_topic(name)
        if named is None:
            self._tell(name, f"{name} names no robot; publish to /7/cmd_vel for robot 7")
        elif not self._wants(*named):
            self._tell(name, "this server is not for it: see its --robot and --topics")
        elif len(self._topics) >= TOPICS:
            self._tell(name, f"clients publish to {TOPICS} topics already; close some")
        else:
            self._topics[key] = topic = _Topic(name, of_type, encoding)
            self._register(topic)

    def unadvertise(self, key: Key) -> None:
        """No more: to the robot its commander is gone."""
        topic = self._topics.pop(key, None)
        if topic is None:
            return
        if topic.registering is not None:
            topic.registering.cancel()
        if topic.publisher is not None:
            topic.publisher.close()

    def publish(self, key: Key, data: bytes, came_s: float) -> None:
        """Send what came at this time of the monotonic clock. What came before the robot has the topic, or too long
        ago, is dropped and counted."""
        topic = self._topics.get(key)
        if topic is None:
            return
        if time.monotonic() - came_s > OLD_S:
            self._agent.drops.note("too_old", topic.name, "a client's command waited for this program")
            return
        if topic.publisher is None or not topic.publisher.is_open:
            self._agent.drops.note("no_node", topic.name, "a client's command came before the robot has its topic")
            self._register(topic)
            return
        try:
            topic.publisher.publish(json.loads(data) if topic.encoding == JSON else data)
        except (MacsError, ValueError, RecursionError) as error:
            self._tell(topic.name, str(error))

    def close(self) -> None:
        """End all of them."""
        for key in list(self._topics):
            self.unadvertise(key)

    def _register(self, topic: _Topic) -> None:
        if topic.registering is None and (not topic.tried_s or time.monotonic() - topic.tried_s > AGAIN_S):
            topic.registering = asyncio.get_running_loop().create_task(self._registered(topic))

    async def _registered(self, topic: _Topic) -> None:
        named = split_topic(topic.name)
        assert named is not None
        try:
            topic.publisher = await self._agent.advertise(named[1], robot=named[0], type=topic.type)
            topic.publisher.on_refused(lambda _, reason: self._tell(topic.name, reason))
        except MacsError as error:
            with suppress(RuntimeError):
                self._tell(topic.name, str(error))
        finally:
            topic.registering, topic.tried_s = None, time.monotonic()
