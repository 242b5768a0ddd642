"""What headsets sent to a robot, sent again: this moves it.

Only for a robot that was named twice. Its rules, control, dead-man and emergency stop hold as for any headset.
"""

from __future__ import annotations

import logging
from pathlib import Path

from bridge.recording.bag import Bag
from bridge.recording.mcap_records import ChannelRecord
from bridge.recording.streams import CDR
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Closed, Unreachable, UsageError
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.offers import short_type
from macs_zenoh.topics import TopicPublisher

log = logging.getLogger("macs.replay")


def is_command(channel: ChannelRecord, robot: int) -> bool:
    """Whether a channel has what was sent to this robot."""
    return (
        channel.encoding == CDR
        and channel.metadata.get("as") == "sent"
        and channel.metadata.get("robot") == str(robot)
        and bool(channel.metadata.get("topic"))
    )


class Commands:
    """Plays the commands of a recording that were for ``recorded`` to robot ``robot``."""

    def __init__(self, path: Path, recorded: int, robot: int) -> None:
        """Raises BadBag, UsageError: there are none."""
        self.robot = robot
        self.sent = 0
        self.refused: dict[str, int] = {}
        """Why the robot did not take some, and how often it said so."""
        with Bag(path) as bag:
            self._channels = {
                channel.id: (channel.metadata["topic"], schema.name)
                for channel in bag.channels.values()
                if is_command(channel, recorded) and (schema := bag.schema_of(channel)) is not None
            }
        if not self._channels:
            raise UsageError(f"{path} has no commands to robot {recorded}; record with --commands")
        self._publishers: dict[int, TopicPublisher] = {}

    @property
    def topics(self) -> list[str]:
        """Where they go."""
        return sorted({topic for topic, _ in self._channels.values()})

    def wants(self, channel: ChannelRecord) -> bool:
        """Whether a channel is played."""
        return channel.id in self._channels

    async def open(self, agent: Agent) -> None:
        """Register. Raises Unreachable: the robot is not online; Refused: it does not let us."""
        if (ROS, self.robot) not in agent.directory:
            raise Unreachable(f"ros/{self.robot}", "it is not online")
        by_topic: dict[str, TopicPublisher] = {}
        for channel, (topic, of_type) in self._channels.items():
            if topic not in by_topic:
                by_topic[topic] = await agent.advertise(topic, robot=self.robot, type=short_type(of_type))
                by_topic[topic].on_refused(self._refused)
            self._publishers[channel] = by_topic[topic]

    def put(self, channel: int, cdr: bytes) -> None:
        """A command is due. On the loop."""
        try:
            self._publishers[channel].publish(cdr)
            self.sent += 1
        except Closed:
            log.debug("a command came after the end")

    def _refused(self, _robot: int, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1

    def close(self) -> None:
        """Deregister: to the robot its commander is gone."""
        for publisher in set(self._publishers.values()):
            publisher.close()
