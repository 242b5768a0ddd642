"""An emergency stop that is sent as data, asked for as well. Asyncio.

What somebody publishes on the topic of a robot's stop goes to the robot with everything else that is put there, and
behind what anybody floods it with. The verb ``stop`` does not (`bridge.ros.stop_line`). So whoever sends a stop calls
it too: an agent for itself, a gateway in the name of its headsets. Only on the topic that robots have by default:
others, only robots know.

A release goes the way that it always took, but never past a question: as long as one is on its way the release of the
same sender waits, for the robot would be stopped again when the question comes. A press that follows takes its place.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from functools import partial

from .errors import MacsError
from .mesh import Mesh, Traffic
from .protocol.budget import may_have_one_more
from .protocol.directory import Directory
from .protocol.guard import STOP_TOPIC, presses
from .protocol.messages import EVERYBODY, ROS, Metadata, node_name
from .protocol.routing import call
from .protocol.wire import Header, Layout

STOP_NAME = node_name(STOP_TOPIC)
ANSWER_S = 1.0
AGAIN_S = 0.1
"""So long after a question the next one about the same robot, whatever became of it: one may get lost."""
SETTLED_S = 0.1
"""After so long nobody takes a release for one that was sent before the stop: robots know such times within that."""
EACH, IN_ALL = 64, 1024
"""Questions of one sender, and of all, that are open at once; what is more goes the usual way only."""
HELD = 64
"""Releases of one sender that wait, by where they go; what is more does not wait."""

Sender = tuple[int, int]
"""Type and id."""
Destination = tuple[int, tuple[int, ...], tuple[int, ...]]
"""Type, ids and groups."""


class Looked(Enum):
    """What becomes of a command on the stop's topic."""

    GOES = "goes"
    REPLACES = "replaces"
    """It goes; a release that waited is not sent any more."""
    WAITS = "waits"
    WAITS_INSTEAD = "waits instead"
    """Of one that waited before."""


GOES, REPLACES, WAITS, WAITS_INSTEAD = Looked.GOES, Looked.REPLACES, Looked.WAITS, Looked.WAITS_INSTEAD


@dataclass
class _Release:
    """What waits until questions about these robots are settled."""

    robots: set[int]
    put: Callable[[], object]


class Presses:
    """Of all that send through one session."""

    def __init__(self, mesh: Mesh, directory: Directory) -> None:
        self._mesh = mesh
        self._directory = directory
        self._layout = Layout(mesh.settings.id_slots, mesh.settings.group_slots)
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._unsettled: Counter[tuple[Sender, int]] = Counter()
        """Questions by who asks and which robot, from when they are asked until a release may follow."""
        self._open: Counter[Sender] = Counter()
        self._asked_at: dict[tuple[Sender, int], float] = {}
        self._held: dict[Sender, dict[Destination, _Release]] = {}

    def look(self, sender: Sender, header: Header, data: bytes, put: Callable[[], object]) -> Looked:
        """A command on the stop's topic is on its way to robots; of several in one go ``data`` is the last one's.

        What becomes of it: ``put`` is called for what waits, when it may go on.
        """
        robots = set(self._robots(header))
        if presses(data):
            for robot in robots:
                self._press(sender, robot)
            return REPLACES if self._drop_releases(sender, robots) else GOES
        held, where = self._held.get(sender, {}), header[:3]
        if not self._is_asking(sender, robots) or (where not in held and len(held) >= HELD):
            return GOES
        replaces = where in held
        self._held.setdefault(sender, {})[where] = _Release(robots, put)
        return WAITS_INSTEAD if replaces else WAITS

    def leave(self, sender: Sender) -> None:
        """It has left, or gets another id: what waits of it goes now, or never."""
        for release in self._held.pop(sender, {}).values():
            release.put()

    def close(self) -> None:
        """Ask no more."""
        for sender in list(self._held):
            self.leave(sender)
        for task in self._tasks:
            task.cancel()

    def _drop_releases(self, sender: Sender, robots: set[int]) -> bool:
        """Those that would follow a press on one of these robots."""
        held = self._held.get(sender, {})
        dropped = [where for where, release in held.items() if not release.robots.isdisjoint(robots)]
        for where in dropped:
            del held[where]
        if not held:
            self._held.pop(sender, None)
        return bool(dropped)

    def _is_asking(self, sender: Sender, robots: Iterable[int]) -> bool:
        return any((sender, robot) in self._unsettled for robot in robots)

    def _robots(self, header: Header) -> Iterable[int]:
        if header.agent_type == EVERYBODY:
            return self._directory.ids(ROS)
        if header.agent_type != ROS:
            return ()
        groups = set(header.groups)
        members = (agent.id for agent in self._directory.of_type(ROS) if agent.group in groups)
        online = (robot for robot in header.ids if (ROS, robot) in self._directory)
        return {*online, *(members if groups else ())}

    def _press(self, sender: Sender, robot: int) -> None:
        about, now = (sender, robot), self._loop.time()
        if now < self._asked_at.get(about, now - AGAIN_S) + AGAIN_S:
            return
        if not may_have_one_more(self._open.total(), self._open[sender], each=EACH, total=IN_ALL):
            return
        self._asked_at[about] = now
        self._unsettled[about] += 1
        self._open[sender] += 1
        asking = self._loop.create_task(self._ask(sender, robot))
        self._tasks.add(asking)
        asking.add_done_callback(partial(self._asked, sender, robot))

    async def _ask(self, sender: Sender, robot: int) -> None:
        said = Metadata(*sender, node_name=STOP_NAME)
        key, frame = call((ROS, robot), "stop", sender, b"true", said, self._layout)
        with suppress(MacsError):  # the data says it as well, and its sender is told what became of that
            await self._mesh.query(key, frame, timeout_s=ANSWER_S, traffic=Traffic.COMMAND)

    def _asked(self, sender: Sender, robot: int, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        self._open[sender] -= 1
        if not self._open[sender]:
            del self._open[sender]
        if not task.cancelled():
            self._loop.call_later(SETTLED_S, self._settled, sender, robot)

    def _settled(self, sender: Sender, robot: int) -> None:
        about = (sender, robot)
        self._unsettled[about] -= 1
        if self._unsettled[about]:
            return
        del self._unsettled[about], self._asked_at[about]
        held = self._held.get(sender, {})
        for where, release in list(held.items()):
            if not self._is_asking(sender, release.robots):
                del held[where]
                release.put()
        if not held:
            self._held.pop(sender, None)
