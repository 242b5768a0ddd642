"""Asking who drives: what comes behind an answer was said after the question (`macs_zenoh.protocol.recency`)."""

from __future__ import annotations

import asyncio
import time

from macs_zenoh.protocol.messages import UNITY
from macs_zenoh.protocol.recency import Recency

from .connection import Connection

ASKED_FOR_S = 600.0
"""So long after its last command an agent is asked: when it drives on, what it says is known to be recent."""


class Questions:
    """To all headsets of a gateway that drive for longer than a moment."""

    def __init__(self) -> None:
        self._timers: dict[Connection, asyncio.TimerHandle] = {}

    def drives(self, connection: Connection) -> None:
        """It has sent a command."""
        if connection in self._timers or connection.peer.agent_type != UNITY:
            return
        pace = connection.pace
        if pace.drives_on or pace.in_doubt:  # after a long pause a single command is no flow yet, but waits for this
            self._ask_on(connection)

    def answered(self, connection: Connection, number: int) -> None:
        """It has answered."""
        connection.pace.answered(number, time.monotonic())
        if connection.pace.in_doubt:
            self._ask(connection)

    def leave(self, connection: Connection) -> None:
        """Nobody is there to answer."""
        timer = self._timers.pop(connection, None)
        if timer is not None:
            timer.cancel()

    def close(self) -> None:
        """Ask no more."""
        for connection in list(self._timers):
            self.leave(connection)

    def _ask_on(self, connection: Connection) -> None:
        self._timers.pop(connection, None)
        if time.monotonic() < connection.drove_at + ASKED_FOR_S:
            self._timers[connection] = asyncio.get_running_loop().call_later(Recency.EVERY_S, self._ask_on, connection)
            self._ask(connection)

    def _ask(self, connection: Connection) -> None:
        if connection.full and not connection.pace.in_doubt:
            return  # it would wait behind what the agent does not take, and prove nothing
        number = connection.pace.recency.ask(time.monotonic())
        if number is not None:
            connection.send_call(connection.peer.welcome(number))
