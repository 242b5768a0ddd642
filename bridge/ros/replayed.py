"""A recording played into a ROS graph: raw bytes to topics of their own types, which must be installed here."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from bridge.replay.recorded import RecordedRobot, RecordedTopic
from bridge.ros.session import RosSession
from bridge.ros.types import resolve
from macs_zenoh.errors import Refused

log = logging.getLogger("macs.replay")

DEPTH = 100


class RosTarget:
    """Publishes topics of recorded robots: under their own names where there is one robot, else behind
    ``/robot_7``."""

    def __init__(self, robots: Mapping[int, RecordedRobot], names: Mapping[int, int]) -> None:
        """``names``: as which robot each is played. Raises Unreachable."""
        self._session = RosSession("macs_replay")
        self._publishers: dict[tuple[int, str], Any] = {}
        self.left_out: dict[str, str] = {}
        """Topics that cannot be published here, and why."""
        self._robots = robots
        self._names = names

    async def open(self) -> None:
        """Make the publishers."""
        for robot in self._robots.values():
            prefix = f"/robot_{self._names.get(robot.id, robot.id)}" if len(self._robots) > 1 else ""
            for topic in robot.topics.values():
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
