"""What subscriptions that come late in an agent get of a latched topic: what the first ones have had. Asyncio.

Who comes late hears the topic from its beginning on, and is given what was before as soon as the robot says that its
topic holds it. A robot that does not say so costs one of them a moment, and the others nothing.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING

from .errors import Closed
from .held import Held, Room, latches
from .protocol.messages import ROS
from .timeouts import Deadline
from .topics import Node, TopicMessage, TopicSubscription

if TYPE_CHECKING:
    from .agent import Agent

OFFERS_S = 2.0
"""How long a subscription waits for a robot to say whether the topic is latched."""

NOT_HELD = "not_held"
Before = Mapping[int, tuple[Held[TopicMessage], list[TopicMessage]]]
"""By robot: where it is held what its topic has said to others here, and that."""


class Late:
    """Of all topics of one agent."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._room = Room()
        self._silent: set[int] = set()
        """Robots that have not answered what they offer."""

    def hold(self, node: Node, robot: int, messages: Iterable[TopicMessage]) -> None:
        """For who comes later."""
        held = node.held.get(robot)
        if held is None:
            held = node.held[robot] = Held(self._room)
        for message in messages:
            held.put(message, node.wanted.buffer_size)

    def before(self, node: Node, robots: Collection[int], depth: int) -> Before:
        """What is held now of these robots."""
        return {robot: (node.held[robot], node.held[robot].newest(depth)) for robot in robots if robot in node.held}

    async def give(self, to: TopicSubscription, node: Node, before: Before, until: Deadline) -> None:
        """To one that hears the topic since it was so. Raises Closed."""
        for robot in await self._latching(node.topic, before.keys() - self._silent, until):
            held, messages = before[robot]
            if held is node.held.get(robot):  # else the robot has come back, and gives anew what it holds
                to.put_before(messages)
                if held.is_short and len(messages) < to.depth:
                    self._agent.drops.note(NOT_HELD, to.topic, f"what ros/{robot} holds has no room here")
        if not to.is_open:
            raise Closed(f"the subscription of {to.topic}")

    def is_back(self, robot: int) -> None:
        """Or has gone: it may answer now."""
        self._silent.discard(robot)

    async def _latching(self, topic: str, robots: Collection[int], until: Deadline) -> set[int]:
        """Those that say that their topic holds messages for late ones."""
        left_s = max(0.001, min(OFFERS_S, until.left_s))
        asking = [self._agent.call(ROS, robot, "offers", timeout_s=left_s) for robot in robots]
        latching = set()
        for robot, answer in zip(robots, await asyncio.gather(*asking, return_exceptions=True), strict=True):
            if isinstance(answer, BaseException):
                if left_s == OFFERS_S:
                    self._silent.add(robot)
                self._agent.drops.note(NOT_HELD, topic, f"ros/{robot} does not say whether it is latched")
            elif latches(answer, topic):
                latching.add(robot)
        return latching
