"""Telling robots how many commands were put for them: Zenoh drops a command where a link is full, and tells nobody.

A count goes the way of the commands and behind them, so that a robot knows by it what has not come (`came`). Only
robot agents that say that they count (`RobotStatus.counts_commands`) are told: existing programs go deaf on what they
do not know. Commands to a group or to all are not counted: they have others among their receivers.
"""

from __future__ import annotations

import asyncio
import time

import msgspec

from macs_zenoh.errors import MacsError
from macs_zenoh.known import Known
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.keyexpr import UNICAST
from macs_zenoh.protocol.messages import ROS, Metadata, encode_data
from macs_zenoh.protocol.robot_state import CommandCount
from macs_zenoh.protocol.routing import call
from macs_zenoh.protocol.wire import Layout, encode_frame, encode_message

STATUS_S = 2.0
"""How long a robot may take to say whether it counts."""
TELL_S = 2.0
"""So often robots are told, while there are commands; the first time behind the first."""
TIMES = 3
"""So often after the last: what drops commands drops counts."""
KNOWN = 8192
"""Of so many pairs of an agent and a robot it is known how many commands were put: beyond, it is begun anew."""
URGENT = "real_time"


class _Counts(msgspec.Struct):
    """What of a robot's state matters here."""

    counts_commands: bool = False


class _Put:
    """Commands of one agent to one robot."""

    __slots__ = ("count", "left", "robot_id", "sender", "session", "since", "told")

    def __init__(self, robot_id: int, sender: tuple[int, int], session: tuple[str, int]) -> None:
        self.robot_id = robot_id
        self.sender = sender
        self.session = session
        self.since = time.monotonic_ns()
        self.count = 0
        self.left = TIMES
        self.told = False
        """Whether it was, once."""


class CommandCounts:
    """Those of one gateway's agents. On the loop."""

    def __init__(self, mesh: Mesh, directory: Directory) -> None:
        self._mesh = mesh
        self._directory = directory
        self._layout = Layout(mesh.settings.id_slots, mesh.settings.group_slots)
        self._known = Known(mesh, STATUS_S, _says_yes)
        self._sessions: dict[int, tuple[str, int]] = {}
        """Of robots: who was asked."""
        self._put: dict[str, _Put | None] = {}
        """By key; None: nobody is told of these."""
        self._timer: asyncio.TimerHandle | None = None

    def close(self) -> None:
        """Tell nobody any more."""
        if self._timer is not None:
            self._timer.cancel()
        self._put.clear()

    def put(self, key: str) -> None:
        """A sample of commands was put with this key."""
        try:
            put = self._put[key]
        except KeyError:
            put = self._begin(key)
        if put is not None:
            put.count += 1
            put.left = TIMES
            if not put.told:
                self._tell(key, put)

    def _begin(self, key: str) -> _Put | None:
        if len(self._put) >= KNOWN:
            self._put.clear()
        self._put[key] = put = self._counted(key)
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(TELL_S, self._look)
        return put

    def _counted(self, key: str) -> _Put | None:
        """What is to be counted with this key: a rule may give commands the priority of other messages, by which the
        robot does not tell them apart, and who is behind this gateway is no robot agent."""
        fields = UNICAST.parse(key)
        if fields is None or fields.type != ROS:
            return None
        robot, rule = self._directory.get(ROS, fields.id), self._mesh.policer.of(key)
        if robot is None or robot.zid == self._mesh.zid or (rule is not None and rule.priority not in (None, URGENT)):
            return None
        if self._sessions.get(fields.id) != robot.session:
            self._known.forget(fields.id)
            self._sessions[fields.id] = robot.session
        return _Put(fields.id, fields.sender, robot.session)

    def _look(self) -> None:
        """Tell of those that were put, and forget those of which was told often enough, and robots that have gone."""
        self._timer = None
        for key, put in list(self._put.items()):
            robot = self._directory.get(ROS, put.robot_id) if put is not None else None
            if put is None or not put.left or robot is None or robot.session != put.session:
                del self._put[key]
                continue
            put.left -= 1
            self._tell(key, put)
        if self._put:
            self._timer = asyncio.get_running_loop().call_later(TELL_S, self._look)

    def _tell(self, key: str, put: _Put) -> None:
        """Behind what was put goes how many they were, if the robot counts."""
        if not self._known.holds(put.robot_id, "", lambda: self._question(put)):
            return
        put.told = True
        metadata = Metadata(*put.sender, message_manager=CommandCount.manager)
        message = encode_message(metadata.encode(), encode_data(CommandCount(put.since, put.count)))
        frame = encode_frame(ROS, [put.robot_id], message=message, layout=self._layout)
        self._mesh.put(key, frame, Traffic.COMMAND, beside=True)

    def _question(self, put: _Put) -> tuple[str, bytes]:
        return call((ROS, put.robot_id), "status", put.sender, b"", Metadata(*put.sender), self._layout)


def _says_yes(answer: bytes | MacsError) -> bool:
    if isinstance(answer, MacsError):
        return False
    try:
        return msgspec.json.decode(answer, type=_Counts).counts_commands
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
