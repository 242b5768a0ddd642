"""Holding back senders behind other gateways, and ours for receivers there.

The receiver's gateway sees that it is full and notes it to the sender's, which from then on reads from the sender
only once in a while: as long as such notes come, and no longer. So a note slows down who sends to that receiver for a
moment and never stops it, whoever forged it, and a receiver that has stopped reading stops nobody. Several that stand
still slow down a sender for no longer together than one: a stop may be behind what it sends them.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from macs_zenoh.mesh import Mesh, Sample, Subscription, Traffic
from macs_zenoh.protocol.directory import AgentInfo, Directory
from macs_zenoh.protocol.keyexpr import SLOW
from macs_zenoh.protocol.registrations import AgentKey
from macs_zenoh.protocol.slow import Note

from .agents import Agents
from .backpressure import HOLD_S, STOPPED_S
from .connection import Connection

NOTED_S = 2 * HOLD_S
"""So long a note holds. It is repeated as long as the receiver is full and moves."""

MOVES_S = STOPPED_S + HOLD_S
"""Notes that go on for longer are of a receiver that moves: of others none come any more."""

RECEIVERS = 64
"""Of so many receivers at once notes are kept for one sender."""


@dataclass(frozen=True)
class FarSender:
    """An agent elsewhere that sends to ``receiver``; for the receiver's `Backpressure`."""

    mesh: Mesh
    key: AgentKey
    zid: str
    receiver: Connection

    @property
    def patience(self) -> None:
        """Its gateway reads from it all the time, four times a second."""
        return None

    def pause(self) -> None:
        """It should slow down."""
        self._note(slow=True)

    def resume(self) -> None:
        """As fast as it likes, when there is room. Of a receiver that has stopped nothing is said any more."""
        receiver = self.receiver
        if receiver.congested:
            receiver.backpressure.hold(self, receiver.moved)
        else:
            self._note(slow=False)

    def _note(self, *, slow: bool) -> None:
        kind, agent_id = self.receiver.key
        key = SLOW.of(zid=self.zid, from_type=kind, from_id=agent_id)
        self.mesh.put(key, Note(*self.key, slow).encode(), Traffic.COMMAND)


@dataclass
class _Notes:
    """Of one receiver that is full: when they began to come, when the last one came."""

    since: float
    last: float

    @property
    def moves(self) -> bool:
        """Whether it does, as far as can be seen from here."""
        return self.last - self.since > MOVES_S


@dataclass
class _Slowed:
    """One of our senders: for which receivers, and how long it has waited for those of which nobody knows that they
    move."""

    receivers: dict[AgentKey, _Notes] = field(default_factory=dict)
    took_s: float = 0.0
    timer: asyncio.TimerHandle | None = None
    """Runs while it is not read from."""


class Afar:
    """Both sides of a gateway. ``slowed`` has those of its connections that are slowed down for others."""

    def __init__(
        self,
        mesh: Mesh,
        agents: Agents,
        directory: Directory,
        sends_to: Callable[[Connection, AgentInfo], bool],
    ) -> None:
        """``sends_to`` says whether a connection has sent to an agent."""
        self._sends_to = sends_to
        self.slowed: dict[Connection, _Slowed] = {}
        self._mesh = mesh
        self._agents = agents
        self._directory = directory
        self._loop = asyncio.get_running_loop()

    def listen(self) -> Subscription:
        """Hear what other gateways note."""
        return self._mesh.subscribe(SLOW.every(zid=self._mesh.zid), self._heard)

    # -- receivers here ------------------------------------------------------------------------------------------

    def hold(self, sender: AgentKey, receiver: Connection) -> None:
        """Slow down a sender that is none of ours while one of ours is full."""
        info = self._directory.get(*sender)
        if info is not None and info.zid != self._mesh.zid:
            receiver.backpressure.hold(FarSender(self._mesh, sender, info.zid, receiver), receiver.moved)

    # -- senders here --------------------------------------------------------------------------------------------

    def has_read(self, connection: Connection) -> None:
        """A frame was read from one of `slowed`: no more for a while."""
        slowed = self.slowed[connection]
        if slowed.timer is None and self._lasts(connection, slowed) and self._may_wait(connection, slowed):
            connection.pause()
            slowed.timer = self._loop.call_later(HOLD_S, self._read_again, connection, slowed)

    def _may_wait(self, connection: Connection, slowed: _Slowed) -> bool:
        moves = any(notes.moves for notes in slowed.receivers.values())
        if moves:
            self._have_moved(connection, slowed)
        costs_s = connection.patience.take(HOLD_S, self._loop.time(), moves=moves)
        slowed.took_s += costs_s or 0.0
        return costs_s is not None

    def _have_moved(self, connection: Connection, slowed: _Slowed) -> None:
        """What held it does not count."""
        connection.patience.give_back(slowed.took_s)
        slowed.took_s = 0.0

    def leave(self, connection: Connection) -> None:
        """It has ended."""
        slowed = self.slowed.pop(connection, None)
        if slowed is not None and slowed.timer is not None:
            slowed.timer.cancel()

    def _heard(self, batch: Iterator[Sample]) -> None:
        for key, payload in batch:
            fields, note = SLOW.parse(key), Note.decode(payload)
            connection = self._agents.find(note.agent_type, note.agent_id) if note is not None else None
            if fields is None or note is None or connection is None:
                continue
            receiver = fields.sender
            if note.slow:
                info = self._directory.get(*receiver)
                if info is not None and self._sends_to(connection, info):
                    self._slow_down(connection, receiver)
            elif (slowed := self.slowed.get(connection)) is not None:
                if slowed.receivers.pop(receiver, None) is not None:
                    self._have_moved(connection, slowed)
                if not slowed.receivers:
                    self._end(connection, slowed)

    def _slow_down(self, connection: Connection, receiver: AgentKey) -> None:
        if connection.drives:
            return
        now, begins = self._loop.time(), connection not in self.slowed
        slowed = self.slowed.setdefault(connection, _Slowed())
        if (notes := slowed.receivers.get(receiver)) is not None:
            notes.last = now
        elif len(slowed.receivers) < RECEIVERS:
            slowed.receivers[receiver] = _Notes(now, now)
        if begins:
            self.has_read(connection)  # later on only after a frame: a large one must come to its end

    def _lasts(self, connection: Connection, slowed: _Slowed) -> bool:
        """Whether any receiver is still full; else it is over."""
        since = self._loop.time() - NOTED_S
        slowed.receivers = {agent: notes for agent, notes in slowed.receivers.items() if notes.last > since}
        if not slowed.receivers:
            self._end(connection, slowed)
        return bool(slowed.receivers)

    def _read_again(self, connection: Connection, slowed: _Slowed) -> None:
        """It has waited."""
        if not self._lasts(connection, slowed):
            return
        slowed.timer = None
        connection.resume()

    def _end(self, connection: Connection, slowed: _Slowed) -> None:
        del self.slowed[connection]
        if slowed.timer is not None:
            slowed.timer.cancel()
            connection.resume()
