"""Agents whose socket is gone and who may come back over another: asleep until they do, or their time is over.

For others an agent that sleeps is online: what is said to it waits, as for one that reads slowly, and what it
registered stays. Only what it was moving stops: its presence says that it sleeps, which robots take as they take its
leaving, as far as that is about commands. How the same state machine goes on behind another socket is in
`macs_zenoh.protocol.tcp_agent`, what is said again in `macs_zenoh.protocol.kept`.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Callable

from macs_zenoh.presence import Presence
from macs_zenoh.protocol.budget import Budget
from macs_zenoh.protocol.kept import Kept, Room
from macs_zenoh.protocol.limits import (
    ASLEEP_IN_ALL,
    ASLEEP_PER_ADDRESS,
    KEPT_BYTES,
    KEPT_IN_ALL_BYTES,
    KEPT_MESSAGES,
)
from macs_zenoh.protocol.messages import UNITY, SessionOpened
from macs_zenoh.protocol.recipient import to_agent
from macs_zenoh.protocol.rights import Grant
from macs_zenoh.protocol.sessions import SECRET_BYTES, Sessions, new_secret
from macs_zenoh.protocol.tcp_agent import Resume, Resumed, TcpAgent

from .agents import Agents
from .connection import Connection
from .departures import Turnstile

CALM_S = 0.25
"""So long after it fell asleep an agent is seen awake again. An agent's presence that changes sooner than routers tell
of it can seem to have ended to its own gateway."""

log = logging.getLogger("macs.gateway")

Note = Callable[[str, Connection], None]
"""An event for the record of who did what."""


class Sleepers:
    """Those of one gateway."""

    def __init__(
        self,
        resume_s: float,
        agents: Agents,
        presence: Presence,
        *,
        on_asleep: Callable[[Connection], None],
        note: Note,
    ) -> None:
        """``resume_s`` is how long one may sleep, 0 for not at all. ``on_asleep`` hears of a connection whose socket
        is gone, before its agent sleeps."""
        self._resume_s = resume_s
        self._agents = agents
        self._presence = presence
        self._on_asleep = on_asleep
        self._note = note
        self._sessions: Sessions[Connection] = Sessions()
        self._room = Room(KEPT_IN_ALL_BYTES)
        self._asleep = Budget("agents asleep", each=1, per_address=ASLEEP_PER_ADDRESS, total=ASLEEP_IN_ALL)
        self._timers: dict[Connection, asyncio.TimerHandle] = {}
        """For how long who sleeps may sleep."""
        self._showing: dict[Connection, asyncio.TimerHandle] = {}
        """Who is awake and not yet seen so."""
        self._naps: dict[Connection, int] = {}
        """How often who has slept has."""
        self._seen: dict[Connection, tuple[int, float]] = {}
        """Of who has slept: which of its naps others know of, and since when they see it as they do."""
        self._seen_late = Turnstile(self._show_late)
        self._closed = False

    def __len__(self) -> int:
        """How many sleep."""
        return len(self._timers)

    @property
    def kept_bytes(self) -> int:
        """What is kept for all who may come back."""
        return self._room.bytes

    def close(self) -> None:
        """Nobody comes back any more."""
        self._closed = True

    def joined(self, connection: Connection) -> None:
        """An agent is online: it may be one that comes back. Only headsets do: no command may wait for a robot."""
        if connection.peer.returns and connection.peer.agent_type == UNITY:
            secret = new_secret(secrets.token_bytes(SECRET_BYTES))
            self._sessions.open(secret, connection)
            connection.send_call(to_agent(SessionOpened(secret, self._resume_s)))
            connection.expect_back(Kept(KEPT_BYTES, KEPT_MESSAGES, self._room))  # counted from here on

    def left(self, connection: Connection) -> None:
        """An agent has gone for good."""
        self._sessions.close(connection)
        self._up(connection)
        self._naps.pop(connection, None)
        self._seen.pop(connection, None)
        if (showing := self._showing.pop(connection, None)) is not None:
            showing.cancel()

    def resume_for(self, newcomer: Connection) -> Resume:
        """How the secret is judged that a newcomer shows."""

        def resume(secret: str, grant: Grant, agent_type: int) -> TcpAgent | None:
            found = self._sessions.find(secret)
            if found is None or found is newcomer or self._closed or not found.returns:
                return None
            if (found.peer.grant.name, found.peer.agent_type) != (grant.name, agent_type):
                return None
            return found.peer

        return resume

    def sleeps(self, connection: Connection) -> bool:
        """A socket is gone: whether its agent sleeps now."""
        if self._closed or not connection.returns or self._agents.find(*connection.key) is not connection:
            return False
        why = self._asleep.judge(connection, connection.host)
        if why is not None:
            connection.complain("not_kept", f"it may not come back as the same: {why}")
            return False
        self._lay_down(connection)
        log.info("%s is asleep: its connection has ended", connection)
        self._note("asleep", connection)
        return True

    def resumed(self, newcomer: Connection, event: Resumed) -> Connection:
        """A newcomer is an agent that was here before; returns its connection. What was the newcomer's own is for the
        caller to take back."""
        connection = self._agents.find(event.former.agent_type, event.former.agent_id)
        assert connection is not None
        if not connection.asleep:  # its old socket has not ended yet, or nobody has noticed
            self._lay_down(connection)
        self._up(connection)
        connection.wake(newcomer, event.received, event.heard)
        self._show_soon(connection)
        log.info("%s is there again", connection)
        self._note("resumed", connection)
        return connection

    # -- pieces --------------------------------------------------------------------------------------------------

    def _lay_down(self, connection: Connection) -> None:
        self._on_asleep(connection)
        connection.fall_asleep()
        self._naps[connection] = self._naps.get(connection, 0) + 1
        self._asleep.set(connection, connection.host, 1)
        loop = asyncio.get_running_loop()
        self._timers[connection] = loop.call_later(self._resume_s, self._has_overslept, connection)
        self._show_soon(connection)

    def _up(self, connection: Connection) -> None:
        """It sleeps no more."""
        if (timer := self._timers.pop(connection, None)) is not None:
            timer.cancel()
            self._asleep.set(connection, connection.host, 0)

    def _has_overslept(self, connection: Connection) -> None:
        log.info("%s leaves: it has not come back within %g s", connection, self._resume_s)
        connection.abort()

    def _show_soon(self, connection: Connection) -> None:
        """Let others see that it sleeps, or does not. Many can fall asleep in one moment, and a router takes a while
        for each: first those that robots stop what they were moving for."""
        if (showing := self._showing.pop(connection, None)) is not None:
            showing.cancel()
        self._seen_late.put(connection, first=connection.is_needed)

    def _show_late(self, connection: Connection) -> None:
        """What is so by now. In no moment it seems to be gone, and no longer than that it is seen as before. Who was
        moving something and is back before it was its turn is seen asleep all the same: robots stop that."""
        is_asleep, nap = connection in self._timers, self._naps.get(connection, 0)
        seen_nap, seen_at = self._seen.get(connection, (0, 0.0))
        asleep = nap if is_asleep or (connection.is_needed and nap != seen_nap) else 0
        if connection.seen_asleep == asleep or self._agents.presence(connection) is None:
            return
        now = asyncio.get_running_loop().time()
        if not asleep and now < seen_at + CALM_S:
            self._show_at(connection, seen_at + CALM_S)
            return
        connection.seen_asleep = asleep
        self._seen[connection] = nap, now
        kind, agent_id = connection.key
        group, epoch = self._agents.group_of(connection), self._agents.epoch(connection)
        token = self._presence.declare(kind, agent_id, group, epoch, asleep=asleep)
        self._agents.replace_token(connection, token).close()
        if asleep and not is_asleep:
            self._show_at(connection, now + CALM_S)

    def _show_at(self, connection: Connection, when: float) -> None:
        if connection not in self._showing:
            self._showing[connection] = asyncio.get_running_loop().call_at(when, self._show_soon, connection)
