"""What headsets sent to a robot, sent again: this moves it.

Only for a robot that was named twice. Its rules, control, dead-man and emergency stop hold as for any headset. Those
of one headset are sent, and never its emergency stop, which could release one that somebody has pressed because of
this. The first refusal ends it: what comes after a command that was not taken was not meant without it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from bridge.recording.bag import Bag
from bridge.recording.conditions import stop_topic
from bridge.recording.mcap_records import ChannelRecord
from bridge.recording.streams import CDR
from bridge.replay.recorded import is_stop
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Closed, MacsError, Unreachable, UsageError
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.messages import ROS, decode_data
from macs_zenoh.protocol.offers import short_type
from macs_zenoh.protocol.robot_state import RobotStatus
from macs_zenoh.topics import TopicPublisher

log = logging.getLogger("macs.replay")

JUDGED_S = 2.0
"""So long the robot's answer is waited for at the end; existing robot programs give none."""

LATE_S = 0.2
"""A command that is later than this is left out: the program was stopped, or had other work."""


def is_command(channel: ChannelRecord, robot: int) -> bool:
    """Whether a channel has what was sent to this robot."""
    return (
        channel.encoding == CDR
        and channel.metadata.get("as") == "sent"
        and channel.metadata.get("robot") == str(robot)
        and bool(channel.metadata.get("topic"))
    )


class Commands:
    """Plays the commands of a recording that were for ``recorded`` to robot ``robot``.

    ``wants(topic)``: which; ``sender``: whose, as ``unity/256``; empty where only one sent any.
    """

    def __init__(
        self,
        path: Path,
        recorded: int,
        robot: int,
        wants: Callable[[str], bool] = lambda topic: True,
        sender: str = "",
    ) -> None:
        """Raises BadBag, UsageError: there are none, or those of several."""
        self.robot = robot
        self.sent = 0
        self.late = 0
        """What was not sent, as it had waited for this program."""
        self.ended = asyncio.Event()
        self.refused: dict[str, int] = {}
        """Why the robot did not take some, and how often it said so."""
        with Bag(path) as bag:
            found = [channel for channel in bag.channels.values() if is_command(channel, recorded)]
            found = [
                channel
                for channel in found
                if wants(channel.metadata["topic"]) and not is_stop(channel.metadata["topic"])
            ]
            senders = sorted({channel.metadata.get("sender", "") for channel in found})
            self._channels = {
                channel.id: (channel.metadata["topic"], schema.name)
                for channel in found
                if sender in ("", channel.metadata.get("sender")) and (schema := bag.schema_of(channel)) is not None
            }
        if not self._channels:
            by = f" of {sender} (others sent some: {', '.join(senders)})" if sender and senders else ""
            raise UsageError(f"{path} has no commands to robot {recorded}{by}; record with --commands")
        if len(senders) > 1 and not sender:
            raise UsageError(f"several sent commands to robot {recorded}: {', '.join(senders)}; say whose: --sender")
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
        agent.on_presence(self._presence)
        await self._leave_out_stop(agent)
        by_topic: dict[str, TopicPublisher] = {}
        for channel, (topic, of_type) in self._channels.items():
            if topic not in by_topic:
                by_topic[topic] = await agent.advertise(topic, robot=self.robot, type=short_type(of_type))
                by_topic[topic].on_refused(self._refused)
            self._publishers[channel] = by_topic[topic]

    async def _leave_out_stop(self, agent: Agent) -> None:
        """Its emergency stop may have another name. Existing robot programs do not tell, and have none."""
        try:
            status = decode_data(RobotStatus, await agent.call(ROS, self.robot, "status"), ANSWER_BYTES)
        except MacsError as error:
            log.debug("robot %d does not tell its emergency stop: %s", self.robot, error)
            return
        stop = stop_topic(status)
        self._channels = {number: named for number, named in self._channels.items() if named[0] != stop}
        if not self._channels:
            raise UsageError(f"the recording has nothing for robot {self.robot} but its emergency stop")

    def put(self, channel: int, cdr: bytes, due_s: float) -> None:
        """A command was due at this time of the monotonic clock. On the loop."""
        if channel not in self._publishers or self.ended.is_set():
            return
        if time.monotonic() - due_s > LATE_S:
            self.late += 1
            return
        try:
            self._publishers[channel].publish(cdr)
            self.sent += 1
        except Closed:
            log.debug("a command came after the end")

    async def judged(self, agent: Agent) -> None:
        """Wait until the robot has seen to the last command: it answers what is asked behind it. To deregister at once
        could end the node before, and a refusal would come when nobody listens."""
        with suppress(MacsError):
            await agent.call(ROS, self.robot, "status", timeout_s=JUDGED_S)

    def _refused(self, _robot: int, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1
        self.ended.set()

    def _presence(self, agent: AgentInfo, online: bool) -> None:
        if (agent.type, agent.id) == (ROS, self.robot) and not online:
            self._refused(self.robot, "it has left")

    def close(self) -> None:
        """Deregister: to the robot its commander is gone."""
        for publisher in set(self._publishers.values()):
            publisher.close()
