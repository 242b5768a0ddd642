"""Holding back senders behind other gateways, and ours for receivers there.

The receiver's gateway sees that it is full and notes it to the sender's, which from then on reads from the sender
only once in a while: as long as such notes come, and no longer. So a note slows down who sends to that receiver for a
moment and never stops it, whoever forged it, and a receiver that has stopped reading stops nobody.
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
from .backpressure import HOLD_S
from .connection import Connection

NOTED_S = 2 * HOLD_S
"""So long a note holds. It is repeated as long as the receiver is full and moves."""

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
        """As fast as it likes, unless the receiver is still full and has moved."""
        receiver = self.receiver
        if not (receiver.congested and receiver.backpressure.hold(self, receiver.moved)):
            self._note(slow=False)

    def _note(self, *, slow: bool) -> None:
        kind, agent_id = self.receiver.key
        key = SLOW.of(zid=self.zid, from_type=kind, from_id=agent_id)
        self.mesh.put(key, Note(*self.key, slow).encode(), Traffic.COMMAND)


@dataclass
class _Slowed:
    """One of our senders: until when it is slow for which receivers."""

    receivers: dict[AgentKey, float] = field(default_factory=dict)
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
        if slowed.timer is None:
            connection.pause()
            slowed.timer = self._loop.call_later(HOLD_S, self._read_again, connection, slowed)

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
                slowed.receivers.pop(receiver, None)
                if not slowed.receivers:
                    self._end(connection, slowed)

    def _slow_down(self, connection: Connection, receiver: AgentKey) -> None:
        if connection.drives:
            return
        slowed = self.slowed.get(connection)
        if slowed is None:
            slowed = self.slowed[connection] = _Slowed()
            self.has_read(connection)  # later on only after a frame: a large one must come to its end
        if receiver in slowed.receivers or len(slowed.receivers) < RECEIVERS:
            slowed.receivers[receiver] = self._loop.time() + NOTED_S

    def _read_again(self, connection: Connection, slowed: _Slowed) -> None:
        """It has waited."""
        now = self._loop.time()
        slowed.receivers = {agent: until for agent, until in slowed.receivers.items() if until > now}
        if not slowed.receivers:
            self._end(connection, slowed)
            return
        slowed.timer = None
        connection.resume()

    def _end(self, connection: Connection, slowed: _Slowed) -> None:
        del self.slowed[connection]
        if slowed.timer is not None:
            slowed.timer.cancel()
            connection.resume()
