"""How a connection comes to an agent's id: who is let in, who waits, and in which order they are greeted."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from bridge.settings import GatewaySettings
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.budget import Budget
from macs_zenoh.protocol.keyexpr import BLOCK_SIZE

from .admission import Admission, Churn
from .connection import Connection
from .departures import PIECE_S
from .leases import Leases
from .record import Record
from .waiting import WaitingRoom

EVERY_ID = 1 << 16
"""All ids of a mesh."""


class Entry:
    """That of one gateway."""

    def __init__(
        self,
        settings: GatewaySettings,
        leases: Leases,
        losses: Losses,
        record: Record,
        *,
        is_taken: Callable[[int], bool],
        on_id: Callable[[Connection, int], None],
    ) -> None:
        """``is_taken`` says which ids of our blocks headsets do not get; ``on_id`` greets a connection."""
        self._leases = leases
        self._losses = losses
        self._record = record
        self._is_taken = is_taken
        self._on_id = on_id
        self.admission = Admission(
            settings.allow, settings.max_connections, settings.max_connections_per_address, settings.groups
        )
        self.churn = Churn()
        ids = len(set(settings.blocks)) * BLOCK_SIZE
        self._ids = Budget("ids", each=1, per_address=ids - ids // 8, total=EVERY_ID) if ids else None
        """Where there are only some: one address never takes all. Who waits for one, or sleeps, counts."""
        self._most_to_join = ids - ids // 4
        """Between the two are those who come back: each has another id until it has shown who it was."""
        self._coming: dict[Connection, asyncio.TimerHandle] = {}
        """Who does not even wait for an id yet, since many from there have come and gone."""
        self._waiting = WaitingRoom(settings.handshake_timeout_s, self._no_id)
        self._greeting: asyncio.Handle | None = None

    def __iter__(self) -> Iterator[Connection]:
        """Who is in, and has no id yet."""
        yield from (*self._waiting, *self._coming)

    def __len__(self) -> int:
        return len(self._waiting) + len(self._coming)

    @property
    def waiting(self) -> int:
        """How many wait for an id."""
        return len(self._waiting)

    @property
    def longest_s(self) -> float:
        """How long the first of them waits."""
        return self._waiting.longest_s

    def close(self) -> None:
        """Nobody is greeted any more."""
        self._waiting.close()

    def let_in(self, connection: Connection) -> bool:
        """Let a connection in, or not. It is greeted at once, or as soon as there is an id for it."""
        connection.stranger = connection.entrance.wants_token(connection.host)
        refusal = self.admission.judge(connection.host, stranger=connection.stranger)
        if refusal is None and self._ids is not None and (why := self._ids.judge(connection, connection.host)):
            refusal = "too_many_ids", f"{why} (gateway.blocks)"
        if refusal is not None:
            name, why = refusal
            self._losses.once(name, "%s is refused: %s", connection.address, why)
            self._record.address("refused", connection.address, name, why)
            return False
        self.admission.enter(connection.host, stranger=connection.stranger)
        self._count(connection, 1)
        wait_s = self.churn.wait_s(connection.host, time.monotonic())
        if wait_s:
            self._losses.once("coming_and_going", "%s waits: many from there have just left", connection.address)
            self._coming[connection] = asyncio.get_running_loop().call_later(wait_s, self._wait, connection)
        else:
            self._wait(connection)
        return True

    def known(self, connection: Connection) -> None:
        """A connection is no stranger any more."""
        if connection.stranger:
            connection.stranger = False
            self.admission.known(connection.host)

    def leave_address(self, connection: Connection) -> None:
        """A socket has ended."""
        self.admission.leave(connection.host)
        self.known(connection)
        if connection.greeted:
            now = time.monotonic()
            self.churn.ended(connection.host, now - connection.greeted_at, now)

    def may_join(self, connection: Connection) -> bool:
        """Whether a connection, not of somebody who comes back, may have its id for longer than to say who it is."""
        if self._ids is None or self._ids.at(connection.host) <= self._most_to_join:
            return True
        why = f"all at one address may have {self._most_to_join} ids (gateway.blocks)"
        self._losses.once("too_many_ids", "%s is refused: %s", connection.address, why)
        self._record.address("refused", connection.address, "too_many_ids", why)
        connection.close(why)
        return False

    def forget(self, connection: Connection) -> None:
        """Nobody has, or waits for, an id any more for this connection."""
        self._count(connection, 0)

    @contextmanager
    def moved(self, connection: Connection) -> Iterator[None]:
        """Within it an agent comes to have another address: its id counts for that."""
        self._count(connection, 0)
        try:
            yield
        finally:
            self._count(connection, 1)

    def _count(self, connection: Connection, ids: int) -> None:
        if self._ids is not None:
            self._ids.set(connection, connection.host, ids)

    def leave(self, connection: Connection) -> None:
        """A connection has ended without an id."""
        if (timer := self._coming.pop(connection, None)) is not None:
            timer.cancel()
        self._waiting.leave(connection)

    def greet_waiting(self) -> None:
        """Give waiting connections ids of our blocks that no agent of any type has, in pieces."""
        if self._greeting is None:
            self._greet_some()

    def _wait(self, connection: Connection) -> None:
        self._coming.pop(connection, None)
        if not self._waiting and self._greeting is None:  # nobody is before it
            agent_id = self._leases.take_id(self._is_taken)
            if agent_id is not None:
                self._on_id(connection, agent_id)
                return
        self._waiting.enter(connection)
        self.greet_waiting()

    def _greet_some(self) -> None:
        self._greeting = None
        until = time.monotonic() + PIECE_S
        while self._waiting:
            if time.monotonic() > until:
                self._greeting = asyncio.get_running_loop().call_soon(self._greet_some)
                return
            agent_id = self._leases.take_id(self._is_taken, wanting=len(self._waiting))
            if agent_id is None:
                if self._leases.exhausted:
                    for connection in self._waiting:
                        self._no_id(connection)
                return
            self._on_id(self._waiting.next(), agent_id)

    def _no_id(self, connection: Connection) -> None:
        """There was no id for a connection in time. It cannot be told: agents give up when anything comes before their
        id, and they are waiting for that."""
        self._waiting.leave(connection)
        self._losses.once("no_id", "%s leaves: there is no id for it", connection.address)
        connection.abort()
