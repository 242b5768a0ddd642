"""Asking who tells when he made his commands what time it is there (`macs_zenoh.protocol.command_clock`)."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress

from bridge.ros.interface import Registrant, Robot
from macs_zenoh.errors import Refused, UsageError, WireError
from macs_zenoh.mesh import now_s
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.command_clock import NO_CLOCK, CommandClocks
from macs_zenoh.protocol.guard import Guard
from macs_zenoh.protocol.messages import ROS, CommandClock, Metadata, decode_data, encode_data
from macs_zenoh.protocol.reading import Message

LOOK_S = 0.25


class ClockQuestions:
    """Of one robot. On the loop."""

    def __init__(self, robot: Robot, guard: Guard | None, check: Callable[[Registrant], None]) -> None:
        """``check`` raises Refused for who may not command: such a one is not asked."""
        self._robot = robot
        self._clocks = guard.clocks if guard is not None else CommandClocks(0)
        if guard is not None:
            guard.on_refused = self._refused
        self._check = check
        self._loop = asyncio.get_running_loop()
        self._open = True
        self._timer: asyncio.TimerHandle | None = None

    def take(self, message: Message) -> None:
        """Somebody said hello, or has answered."""
        sender = Registrant.of(message)
        try:
            self._check(sender)
            said = decode_data(CommandClock, message.data)
        except Refused as refusal:
            self._robot.drops.note("not_allowed", f"{CommandClock.manager} from {sender}", refusal.reason)
            return
        except WireError as error:
            self._robot.drops.note("bad_request", f"{CommandClock.manager} from {sender}", str(error))
            return
        name = str(AgentId(*sender))
        if said.question:
            reply = self._clocks.answered(name, said, now_s())
        else:
            reply = self._clocks.hello(name, said.clock, now_s())
        if reply is not None:
            self._say(sender, reply)
        if self._timer is None:
            self._timer = self._loop.call_later(LOOK_S, self._look)

    def _refused(self, message: Message, kind: str, reason: str) -> None:
        """A command was not carried out. From any thread."""
        self._robot.tell_refused(message, "", kind, reason)
        if kind == NO_CLOCK and self._timer is None:  # nobody has said hello, and this sender may not for long
            self._loop.call_soon_threadsafe(self._begin)

    def left(self, agent: Registrant) -> None:
        """Whoever has this id next has another clock."""
        self._clocks.left(str(AgentId(*agent)))

    def close(self) -> None:
        """Ask no more."""
        self._open = False
        if self._timer is not None:
            self._timer.cancel()

    def _begin(self) -> None:
        if self._open and self._timer is None:
            self._look()

    def _look(self) -> None:
        self._timer = self._loop.call_later(LOOK_S, self._look) if self._clocks.wanted else None
        for name, question in self._clocks.due(now_s()):
            with suppress(Refused, UsageError):
                sender = Registrant(*AgentId.parse(name))
                self._check(sender)
                self._say(sender, question)

    def _say(self, to: Registrant, said: CommandClock) -> None:
        self._robot.send(to, Metadata(ROS, self._robot.agent_id, message_manager=said.manager), encode_data(said))
