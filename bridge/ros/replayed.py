"""A recording played into a ROS graph: raw bytes to topics of their own types, which must be installed here."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from functools import partial
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from bridge.replay.recorded import RecordedRobot, RecordedTopic
from bridge.ros.session import RosSession
from bridge.ros.types import resolve
from macs_zenoh.errors import Refused

log = logging.getLogger("macs.replay")

DEPTH = 100
PREFIX = "/replay/robot_"
"""No robot has such a namespace, as it may have ``/robot_7``: what is played moves nobody."""


class RosTarget:
    """Publishes topics of recorded robots behind ``/replay/robot_7``, where no robot listens.

    One robot's may be under their own names: what it was commanded by, and its emergency stop, are not among them.
    """

    def __init__(
        self,
        robots: Mapping[int, RecordedRobot],
        names: Mapping[int, int],
        *,
        own_names: int = 0,
        named: Collection[str] = (),
    ) -> None:
        """``names``: as which robot each is played; ``own_names``: the recorded robot whose topics keep their names;
        ``named``: topics that were asked for by their whole names. Raises Unreachable."""
        self._session = RosSession("macs_replay")
        self._publishers: dict[tuple[int, str], Any] = {}
        self.left_out: dict[str, str] = {}
        """Topics that cannot be published here, and why."""
        self._robots = robots
        self._names = names
        self._own_names = own_names
        self._named = named

    async def open(self) -> None:
        """Make the publishers."""
        for robot in self._robots.values():
            is_own = robot.id == self._own_names
            prefix = "" if is_own else f"{PREFIX}{self._names.get(robot.id, robot.id)}"
            for topic in robot.topics.values():
                if is_own and (why := robot.moves_by(topic.name, self._named)):
                    self.left_out[topic.name] = why
                    continue
                try:
                    publisher = await self._session.run(partial(self._make, topic, prefix))
                    self._publishers[robot.id, topic.name] = publisher
                    if topic.last is not None:
                        publisher.publish(topic.last)
                except Refused as refusal:
                    self.left_out[f"{prefix}{topic.name}"] = refusal.reason

    def _make(self, topic: RecordedTopic, prefix: str) -> Any:
        profile = QoSProfile(
            depth=1 if topic.is_latched else DEPTH,
            reliability=ReliabilityPolicy[(topic.qos.reliability or "reliable").upper()],
            durability=DurabilityPolicy[(topic.qos.durability or "volatile").upper()],
        )
        return self._session.node.create_publisher(resolve(topic.type), f"{prefix}{topic.name}", profile)

    def put(self, robot: int, topic: RecordedTopic, cdr: bytes) -> None:
        """A message is due. In the player's thread."""
        publisher = self._publishers.get((robot, topic.name))
        if publisher is not None:
            publisher.publish(cdr)

    def close(self) -> None:
        """End the node."""
        self._session.close()
