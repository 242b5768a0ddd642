"""A headset's emergency stop, asked for as well.

What a headset publishes on the topic of a robot's stop goes to the robot with everything else that is put there, and
behind what somebody floods it with. The verb ``stop`` does not (`bridge.ros.stop_line`), so a gateway asks for it too,
in the headset's name. Only on the topic that robots have by default: others, only robots know. A release is not asked
for: it takes the way that it always took.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from contextlib import suppress
from functools import partial

from bridge.settings import RobotSettings
from macs_zenoh.errors import MacsError
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.guard import presses
from macs_zenoh.protocol.messages import BROADCAST, ROS, Metadata, node_name
from macs_zenoh.protocol.routing import call
from macs_zenoh.protocol.wire import Frames, Header, Layout

STOP_NAME = node_name(RobotSettings().stop_topic)
ANSWER_S = 2.0
OPEN = 256
"""Questions at once; what is more goes the usual way only."""

Agent = tuple[int, int]
"""Type and id."""


class Presses:
    """Of all headsets of a gateway."""

    def __init__(self, mesh: Mesh, directory: Directory) -> None:
        self._mesh = mesh
        self._directory = directory
        self._layout = Layout(mesh.settings.id_slots, mesh.settings.group_slots)
        self._open: dict[tuple[Agent, int], asyncio.Task[None]] = {}

    def look(self, sender: Agent, frame: Frames, metadata: Metadata) -> None:
        """A command that may be a stop is on its way to robots."""
        if metadata.node_name != STOP_NAME or not any(presses(bytes(single.body[:5])) for single in frame.each()):
            return
        for robot in self._robots(frame.header):
            if (sender, robot) not in self._open and len(self._open) < OPEN:
                asking = asyncio.get_running_loop().create_task(self._ask(sender, robot))
                self._open[sender, robot] = asking
                asking.add_done_callback(partial(self._asked, sender, robot))

    def _asked(self, sender: Agent, robot: int, _: asyncio.Task[None]) -> None:
        del self._open[sender, robot]

    def close(self) -> None:
        """Ask no more."""
        for asking in self._open.values():
            asking.cancel()

    def _robots(self, header: Header) -> Iterable[int]:
        if header.agent_type == BROADCAST:
            return self._directory.ids(ROS)
        groups = set(header.groups)
        members = (agent.id for agent in self._directory if agent.type == ROS and agent.group in groups)
        return {*header.ids, *(members if groups else ())}

    async def _ask(self, sender: Agent, robot: int) -> None:
        said = Metadata(*sender, node_name=STOP_NAME)
        key, frame = call((ROS, robot), "stop", sender, b"true", said, self._layout)
        with suppress(MacsError):  # the data says it as well, and its sender is told what became of that
            await self._mesh.query(key, frame, timeout_s=ANSWER_S, traffic=Traffic.COMMAND)
