"""One socket: bytes between a TCP agent and its `TcpAgent`, and the queue of an agent that reads too slowly.

One class, though a long one: reading, turns, sleep and end change the same facts of one socket, in view of each other.
"""

from __future__ import annotations

import asyncio
import logging
import math
import sys
import time
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Sequence
from functools import cached_property
from itertools import chain
from typing import cast

from macs_zenoh.errors import NotAdmitted
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.addresses import joined, of_peer
from macs_zenoh.protocol.budget import Toll
from macs_zenoh.protocol.decoders import FrameDecoder
from macs_zenoh.protocol.kept import Kept
from macs_zenoh.protocol.keyexpr import type_name
from macs_zenoh.protocol.limits import REQUESTS_PER_S, UNFINISHED_FREE_BYTES
from macs_zenoh.protocol.messages import ROS, UNITY, AgentsGone, GoneAgent, SessionResumed
from macs_zenoh.protocol.outbox import Chunk, Outbox
from macs_zenoh.protocol.rate_limit import Pace
from macs_zenoh.protocol.recipient import Recipient, to_agent
from macs_zenoh.protocol.tcp_agent import Arrived, Event, Failed, Joined, Left, Rejected, Sent, State, TcpAgent

from .backpressure import Backpressure, Patience
from .door import OPEN_TO_ALL, Entrance
from .memory import Memory
from .owner import Owner
from .shares import LATE_READ_BYTES, TURN_S, Share
from .tcp import is_gone, waiting_bytes
from .writer import BUFFER_BYTES, ENDED, NOBODY, Writer

log = logging.getLogger("macs.gateway")

AWAY_S = 10.0
"""An agent that nothing was heard of for so long, two heartbeats, is away."""

LOOK_S = 1.0
"""How often it is looked whether the host of an agent that is away is gone."""

ASLEEP_BYTES = 1 << 20
"""So much may wait for an agent whose socket is gone, if its outbox has no less."""

TELL_S = 1.0
"""How often an agent is told the same of what it may not do, while it goes on."""
TOLD = 256

IN_FLIGHT = 4
"""While senders are held, so many times the outbox's limit may wait beyond it: what is on its way from those behind
other gateways."""

DRIVES_S = 1.0
"""So long after a command its sender counts as driving."""

READ_S = 0.02
"""How long what waits in a socket has before the agent's time is looked at again."""
READ_WITHIN_S = 5.0
"""So long at most, while it is read from at all: TLS and WebSocket make less of what has come, so nobody can count how
much of it is left."""

MOST_READ_BYTES = FrameDecoder.SPACE_BYTES
FIRST_READ_BYTES = 16 << 10
"""Of many that begin at once nobody knows yet that they take much."""
LEAST_READ_BYTES = 1024
"""Over TLS each byte may be a record of its own, which takes half a microsecond: so much is read of who begins."""


class Connection(asyncio.BufferedProtocol):
    """A TCP agent's socket. Everything it means is decided in `TcpAgent` and by its gateway."""

    stranger = False
    """Whether a token is wanted of its agent, and it has shown none yet."""
    _not_let_in = False
    asleep = False
    """Whether its socket is gone, and the agent may come back over another."""
    unseen = False
    """Whether others may not see its agent yet, which has said nothing but what it is."""
    seen_asleep = 0
    """The so many-th sleep in which others see it; 0 while they see it awake."""
    _successor: Connection | None = None
    """Whose socket it is now, when its agent turned out to be one that was here before."""
    shown_token: str | None = None
    """What was shown before the first frame, where that is possible."""
    greeted = False
    greeted_at = -math.inf
    _timer: asyncio.TimerHandle | None = None
    drove_at = -math.inf
    """When it sent a robot a command last."""
    _refused = False
    _pauses = 0
    _waits = False
    """Whether that waits for its turn: then the agent is not read from."""
    _flushes = False
    """Whether what was gathered for it waits for its turn."""
    _lost = False
    """Whether the socket has ended meanwhile."""
    _closed = False
    """Whether it was closed from here: what it says behind that does not count."""
    received_bytes = 0
    _unfinished = 0
    """What is counted for it of a frame that has begun."""
    _read_bytes = FIRST_READ_BYTES
    """How much is read at once: less, when little of it makes much work, more when much makes little."""
    _read_last: tuple[int, float] | None = None
    """How much was read that waits for its turn, and how long that took."""
    _is_late = False
    """Whether what is read comes late in a long round."""
    _asked_at = 0.0
    """When room for bytes was asked for last."""
    _unread = 0
    """Of what waited in the socket when the agent's time had run out: how much is still to be read."""
    _looked = False
    _read_by = math.inf
    congested = False
    """Whether so much waits for this agent that its senders should slow down."""
    _tolled: asyncio.TimerHandle | None = None
    grouped_at = -math.inf
    """When it came into the group that others see it in, by the loop's clock."""
    regrouping: asyncio.TimerHandle | None = None

    def __init__(
        self,
        owner: Owner,
        entrance: Entrance = OPEN_TO_ALL,
        *,
        memory: Memory,
        outbox_bytes: int,
        write_timeout_s: float,
    ) -> None:
        self.owner = owner
        self.entrance = entrance
        self.peer: TcpAgent
        self.recipient: Recipient
        """What may be said to the agent."""
        self.host = self.address = "?"
        self.drops = Losses(log)
        self._outbox = Outbox(outbox_bytes)
        self._outbox_bytes = outbox_bytes
        self._memory = memory
        self._write_timeout_s = write_timeout_s
        self._transport: asyncio.Transport
        self._writer = Writer(self._outbox)
        self._loop = asyncio.get_running_loop()
        self._told: dict[Hashable, float] = {}
        """What the agent was told of its rights, and when."""
        self._share = Share()
        self._given = Share()
        """The same of what is encrypted for it: it is not read from less for that."""
        self._rest: list[Iterator[Event]] = []
        """What the agent did and is not handled yet, since that takes longer than a turn."""
        self.backpressure = Backpressure()
        self.robot_backpressure = Backpressure()
        """For robot programs, which can wait longer."""
        self.patience = Patience()
        """With others that it sends to."""
        self._toll = Toll(REQUESTS_PER_S)

    @cached_property
    def pace(self) -> Pace:
        """How fast it may send to robots, from when it first does: most only look."""
        return self.owner.pace()

    @property
    def sent_bytes(self) -> int:
        """How much was written for the agent."""
        return self._writer.written_bytes

    @property
    def agent_id(self) -> int:
        """The id that this gateway gave to the connection."""
        return self.peer.agent_id

    @property
    def key(self) -> tuple[int, int]:
        """(agent type, agent id)."""
        return (self.peer.agent_type, self.peer.agent_id)

    def __str__(self) -> str:
        kind = type_name(self.peer.agent_type) if self.peer.agent_type else "agent"
        return f"{kind}/{self.peer.agent_id} at {self.address}"

    # -- asyncio -------------------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport = cast(asyncio.Transport, transport)  # uvloop's is one without saying so
        self._transport = transport
        peer_name = transport.get_extra_info("peername")
        self.host = of_peer(str(peer_name[0])) if peer_name else "?"
        self.address = joined(self.host, peer_name[1]) if peer_name else "?"
        self._writer.attach(transport)
        if self._writer.encrypts:
            self._read_bytes = LEAST_READ_BYTES
        transport.pause_reading()  # until it is greeted
        self._pauses = 1
        if not self.owner.opened(self):
            self._refused = True
            transport.abort()
        elif not self.greeted:
            self._loop.call_soon(self._still_paused)

    def _still_paused(self) -> None:
        """uvloop begins to read after `connection_made`, whatever was said in it; nothing has been read yet."""
        if self._pauses and not self._transport.is_closing():
            self._transport.pause_reading()

    def greet(self, peer: TcpAgent) -> None:
        """The agent has an id: tell it, and begin to listen."""
        self.peer = peer
        self.recipient = peer.recipient
        self.greeted, self.greeted_at = True, time.monotonic()
        self._writer.write([peer.welcome()])
        self.resume()
        self._schedule()

    def get_buffer(self, sizehint: int) -> memoryview:
        self._asked_at = time.monotonic()
        rounds = self._memory.rounds
        self._is_late = rounds.long
        return self.peer.space()[: rounds.most_bytes(self.host, self._share, self._read_bytes)]

    def buffer_updated(self, nbytes: int) -> None:
        # from when it was asked for: what is small over TLS takes longer to decrypt, here and now, than to handle
        self.handle(nbytes, self._asked_at)

    def handle(self, nbytes: int, began: float) -> None:
        """So many bytes have come, with which the loop has been busy since ``began``."""
        self._unread -= nbytes
        self.received_bytes += nbytes
        if (events := self.peer.advance(nbytes, began)) is not None:
            self.take(events, began)
            if self._successor is not None:
                return
        unfinished = self.peer.partial_bytes
        if unfinished != self._unfinished and (unfinished > UNFINISHED_FREE_BYTES or self._unfinished):
            self._note_unfinished(unfinished)
        took_s = time.monotonic() - began
        if self._rest and took_s <= TURN_S:  # how long it takes is known when it has had its turn
            self._read_last = nbytes, took_s
        else:
            self._adapt(nbytes, took_s)
        rounds = self._memory.rounds
        turn_s = rounds.spend(self.host, self._share, took_s)
        if (turn_s or rounds.are_over(self.host)) and not self._waits and not self._transport.is_closing():
            self.pause()
            rounds.enter(self.host, self._share, self.resume, turn_s or took_s)
        elif self._is_late and nbytes >= LATE_READ_BYTES:  # libuv reads on, since there is more
            self._is_late = False
            self.pause()
            self._loop.call_soon(self.resume)

    def _adapt(self, nbytes: int, took_s: float) -> None:
        """Read as much at once as a turn has time for: so many bytes took so long, if nothing of them waits."""
        if took_s > TURN_S:
            part = min(TURN_S / took_s, 0.5 if self._rest else 1.0)
            self._read_bytes = max(LEAST_READ_BYTES, int(self._read_bytes * part))
        elif took_s < TURN_S / 2 and nbytes >= self._read_bytes // 2 and not self._rest:
            self._read_bytes = min(2 * self._read_bytes, MOST_READ_BYTES)

    def _note_unfinished(self, unfinished: int) -> None:
        self._unfinished = unfinished if unfinished > UNFINISHED_FREE_BYTES else 0
        for connection in self._memory.unfinished.note(self, self.host, unfinished):
            connection.cut_unfinished()

    def pause_writing(self) -> None:
        self._writer.pause()
        self._account()
        self._schedule()

    def resume_writing(self) -> None:
        self._writer.resume()
        self._account()
        self.backpressure.has_moved()
        self.robot_backpressure.has_moved()
        if not self._outbox:
            self.congested = False
            self.backpressure.release()
            self.robot_backpressure.release()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = ENDED
        if self._rest:  # what was said before comes first
            self._lost = True
            self._look_no_more()
            return
        if self.greeted and not self._refused and self.owner.sleeps(self):
            return
        self._look_no_more()
        for timer in (self._tolled, self.regrouping):
            if timer is not None:
                timer.cancel()
        self._writer.close_direct()
        self._writer.detach()
        self._expect_back_no_more()
        if self._refused:
            return
        if self.greeted:
            self.peer.lost()
        self.congested = False
        self.backpressure.release()
        self.robot_backpressure.release()
        self._memory.unfinished.note(self, self.host, 0)
        self._memory.waiting.set(self, self.host, 0)
        self.owner.closed(self)

    # -- in ------------------------------------------------------------------------------------------------------

    def take(self, events: Iterable[Event], began: float) -> None:
        """What the agent did: as much as a turn has time for that began then, the rest when others have had theirs.
        All of it, when this round of the loop has done enough for addresses that take much."""
        self._rest.append(iter(events))
        if not self._waits:
            if not self._memory.rounds.are_over(self.host):
                self._handle_some(began)
            if self._rest:
                self._waits = True
                self.pause()
                self._memory.rounds.enter(self.host, self._share, self._handle_on, 0.0)

    def _handle_on(self) -> None:
        began = time.monotonic()
        self._handle_some(began)
        took_s = time.monotonic() - began
        self._memory.rounds.spend(self.host, self._share, took_s)
        if self._read_last is not None:
            nbytes, read_s = self._read_last
            self._read_last = None
            self._adapt(nbytes, read_s + took_s)
        if self._rest:
            self._memory.rounds.enter(self.host, self._share, self._handle_on, 0.0)
            return
        self._waits = False
        if self._memory.rounds.are_over(self.host) and not self._lost:
            self._memory.rounds.enter(self.host, self._share, self.resume, took_s)
        else:
            self.resume()
        if self._lost:
            self._lost = False
            self.connection_lost(None)

    def _handle_some(self, began: float) -> None:
        """Handle what waits, in its order, until the turn is over that began then."""
        for event in self._events():
            try:
                if type(event) is Sent:
                    self.owner.forward(self, event)
                else:
                    self._handle(event)
            except Exception:  # ours to mend; this agent goes on, and so do all others
                if self._fails():
                    log.exception("%s: %s failed (logged once, counted as failed)", self, type(event).__name__)
            if self._successor is not None:
                rest, self._rest = self._rest, []
                self._successor.take(chain.from_iterable(rest), began)
                return
            if isinstance(event, Joined) and self._closed:
                self._rest.clear()  # it was not let in, and nothing that it sent before counts
                return
            if time.monotonic() > began + TURN_S:
                break
        try:
            self.owner.received(self)
        except Exception:
            if self._fails():
                log.exception("%s: what it sent failed (logged once, counted as failed)", self)

    def _events(self) -> Iterator[Event]:
        """What waits, one after the other; whoever has not come to the end finds the rest there."""
        while self._rest:
            try:
                for event in self._rest[0]:  # noqa: UP028 - by that it would end with who leaves off
                    yield event
            except Exception:
                if self._fails():
                    log.exception("%s: reading failed (logged once, counted as failed)", self)
            del self._rest[0]

    def _handle(self, event: Event) -> None:
        if isinstance(event, Rejected):
            if isinstance(event.error, NotAdmitted):
                self._not_let_in = True  # the door tells of all who try, by their addresses
            else:
                self._warn_once(type(event.error).__name__, str(event.error))  # the peer has counted it
        elif isinstance(event, Left):
            if event.silent:
                self._give_up(event.reason)
            else:
                self.close(event.reason)
        elif isinstance(event, Failed):
            if self._fails(event.frames):
                log.error("%s: reading failed (logged once, counted as failed)", self, exc_info=event.error)
        elif isinstance(event, Arrived):
            if self._writer.kept is not None:
                self._writer.kept.arrived(event.received)
        else:
            self.owner.handle(self, event)
            if isinstance(event, Joined) and self._successor is None and not self._transport.is_closing():
                self._schedule()  # from now on silence counts, which may be less than what the handshake has

    def _fails(self, count: int = 1) -> bool:
        """What this agent said could not be carried out, for a reason that nobody thought of; whether that is the
        first time."""
        self.drops["failed"] += count
        return self.drops["failed"] == count

    # -- out -----------------------------------------------------------------------------------------------------

    def send_call(self, message: Chunk) -> None:
        """Send in order, now. What waits is bounded: beyond that the newest is dropped and counted, because an
        existing headset that is disconnected never comes back; one that does not read at all is disconnected in its
        time."""
        self.gather_calls([message])
        self._writer.flush()

    def gather_calls(self, messages: Sequence[Chunk], size: int | None = None) -> bool:
        """The same for several, of ``size`` together, with the next `flush`. Whether the caller has to see to that:
        what is gathered begins with these."""
        if not self._writer.full:
            return self._gather(messages, size, keep=True)
        beyond_bytes = IN_FLIGHT * self._outbox.limit_bytes if self.backpressure.holds else 0
        for message in messages:
            if self._has_room(len(message)) and not self._outbox.put_call(message, beyond_bytes):
                self._warn_once("outbox_full", f"it reads too slowly: {self._outbox.bytes} bytes are waiting")
            self._account()
        self.congested = not self.asleep and self._outbox.bytes > self._outbox.limit_bytes // 4
        return False

    @property
    def full(self) -> bool:
        """Whether what is sent now has to wait."""
        return self._writer.full

    @property
    def moved(self) -> object:
        """Another one whenever the agent has taken some of what is on its way to it."""
        return self._writer.resumed, self._transport.get_write_buffer_size() >> 18

    def gather_stream(self, node: str, messages: Sequence[Chunk], *, keep: bool = False) -> bool:
        """Likewise topic data of a node; the registration's buffer size bounds what waits, unless it is to be kept,
        since its sender is held back."""
        if not self._writer.full:
            return self._gather(messages)
        depth, drop_new = (sys.maxsize, False) if keep else self.recipient.depth_of(node)
        for message in messages:
            if self._has_room(len(message)):
                self._outbox.put_stream(node, message, depth=depth, drop_new=drop_new)
                self._account()
        return False

    def _has_room(self, size: int) -> bool:
        """Whether so much more may wait, as far as others are concerned."""
        why = self._memory.waiting.judge(self, self.host, size)
        if why is not None:
            self.complain("outbox_full", f"it reads too slowly, and {why}")
        return why is None

    def _account(self) -> None:
        """Note what waits for this agent, here and in its transport."""
        waiting = self._outbox.bytes + self._transport.get_write_buffer_size()
        if not self._writer.full and not self._outbox:
            waiting = 0
        self._memory.waiting.set(self, self.host, waiting)

    @property
    def free(self) -> bool:
        """Whether nothing waits to be sent, so that `send_now` can be tried. From any thread."""
        return self._writer.free

    def send_now(self, message: bytes) -> None:
        """Send topic data in a thread of Zenoh's, after seeing that the agent is `free`: into the socket, and what it
        does not take soon on the loop."""
        if not self._writer.write_now(message):
            self._loop.call_soon_threadsafe(self.flush)

    def _gather(self, messages: Sequence[Chunk], size: int | None = None, *, keep: bool = False) -> bool:
        size = sum(map(len, messages)) if size is None else size
        if size > BUFFER_BYTES and not self._has_room(size):
            return False
        return self._writer.gather(messages, size, keep=keep)

    def tell_gone(self, gone: list[GoneAgent]) -> None:
        """Tell a robot program that these have left, if there are any."""
        if gone:
            self.recipient.gone(gone)
            self.send_call(to_agent(AgentsGone(gone)))

    def open_direct(self) -> None:
        """The agent takes a topic, whose messages may go past the loop."""
        self._writer.open_direct()

    def flush(self) -> None:
        """Write what was gathered since the last flush, in one go. What has to be encrypted for one of many that take
        much waits for its turn, but nothing that goes to a robot program."""
        if self._flushes or not self._writer.encrypts or self.peer.agent_type == ROS:
            if not self._flushes:
                self._writer.flush()
        elif self._memory.rounds.are_over(self.host):
            self._flushes = True
            self._memory.rounds.enter(self.host, self._given, self._flush_on, 0.0)
        else:
            self._flush_on()

    def _flush_on(self) -> None:
        self._flushes, began = False, time.monotonic()
        self._writer.flush()
        self._memory.rounds.spend(self.host, self._given, time.monotonic() - began)

    def pause(self) -> None:
        """Stop reading from the agent until as many `resume` as `pause` were called."""
        self._pauses += 1
        if self._pauses == 1 and not self._transport.is_closing():
            self._transport.pause_reading()

    def resume(self) -> None:
        """Read again."""
        self._pauses -= 1
        if self._pauses == 0 and not self._transport.is_closing():
            self._transport.resume_reading()

    def charge(self, requests: int = 1) -> None:
        """The agent asked for something that costs: one that does so too often is not read from for a moment."""
        hold_s = self._toll.pay(time.monotonic(), requests)
        if hold_s > 0 and self.slow_down(hold_s):
            self.complain("slowed_down", f"it asks for more than {REQUESTS_PER_S} things a second")

    def slow_down(self, hold_s: float) -> bool:
        """Do not read from the agent for a moment, unless such a one is under way; whether it begins now."""
        if self._tolled is not None:
            return False
        self.pause()
        self._tolled = self._loop.call_later(hold_s, self._go_on)
        return True

    def _go_on(self) -> None:
        self._tolled = None
        self.peer.floods = False
        self.resume()

    def cut_unfinished(self) -> None:
        """There is too much of frames that have not ended, its address has most of it, and this one began first."""
        self.drops["unfinished_frame"] += 1
        self.close("its frame does not end, and others need the room")

    # -- life ----------------------------------------------------------------------------------------------------

    def may_tell(self, about: Hashable) -> bool:
        """Whether the agent should be told of something again: at once, and then once in a while."""
        now = self._loop.time()
        if now < self._told.get(about, -math.inf) + TELL_S:
            return False
        if len(self._told) >= TOLD:
            self._told.clear()
        self._told[about] = now
        return True

    def complain(self, name: str, problem: str, count: int = 1) -> None:
        """Count what was dropped; the first of a kind is logged."""
        self.drops.once(name, "%s: %s", self, problem, count=count)

    def _warn_once(self, name: str, problem: str) -> None:
        """Log the first of what is counted elsewhere."""
        self.drops.once(name, "%s: %s", self, problem, count=0)

    @property
    def has_ended(self) -> bool:
        """Whether nothing reaches the agent any more, nor comes from it."""
        return self._transport is ENDED and not self._lost and not self.asleep

    def close(self, reason: str) -> None:
        """Send what is gathered, then FIN."""
        if self.has_ended or (self._closed and not self.asleep):
            return
        self._closed = True
        self._expect_back_no_more()
        if not self.asleep:
            self.peer.lost()
        level = logging.INFO if reason == "went offline" else logging.WARNING
        level = logging.DEBUG if self._not_let_in else level
        log.log(level, "%s leaves: %s", self, reason)
        if self.asleep:
            self.abort()
        elif not self._lost:
            self._writer.close(self._write_timeout_s)

    def finish(self, reason: str) -> None:
        """Send all that waits, then FIN; `abort` whoever does not take it in time."""
        if not self.greeted or self.asleep:
            self.abort()
        elif not self._transport.is_closing():
            while self._rest:
                self._handle_some(time.monotonic())
            self._closed = True
            self._expect_back_no_more()
            self.peer.lost()
            log.info("%s leaves: %s", self, reason)
            self._writer.finish()

    def abort(self) -> None:
        """End the connection at once; does nothing to one that has ended."""
        if self.asleep:
            self._expect_back_no_more()
            self.connection_lost(None)
        else:
            self._transport.abort()

    # -- sleep ---------------------------------------------------------------------------------------------------

    @property
    def is_needed(self) -> bool:
        """Whether others wait to hear that it is gone: of a robot, of who commands or serves."""
        return self.greeted and not (self.key[0] == UNITY and self.recipient.only_listens)

    @property
    def returns(self) -> bool:
        """Whether the agent is expected back when its connection ends."""
        return self._writer.kept is not None

    def expect_back(self, kept: Kept[Chunk]) -> None:
        """The agent comes back when its connection ends, and what has not arrived by then is to be said again."""
        self._writer.kept = kept

    def _expect_back_no_more(self) -> None:
        kept, self._writer.kept = self._writer.kept, None
        if kept is not None:
            kept.clear()

    def fall_asleep(self) -> None:
        """The socket has ended, or is to: what is said to the agent waits from now on, and less may than otherwise."""
        transport, self._transport = self._transport, ENDED
        self.asleep = True
        self._writer.fall_asleep()
        self._look_no_more()
        if self._tolled is not None:
            self._tolled.cancel()
            self._go_on()
        if transport is not ENDED:
            transport.set_protocol(NOBODY)
            transport.abort()
        self._outbox.limit_bytes = min(self._outbox_bytes, ASLEEP_BYTES)
        self.congested = False
        self.backpressure.release()
        self.robot_backpressure.release()
        self._memory.unfinished.note(self, self.host, 0)
        self._unfinished = self._unread = 0
        self._account()

    def wake(self, newcomer: Connection, received: int, heard: int) -> None:
        """The agent is there again, as a newcomer who has ``received`` so much and was ``heard`` so far: what is the
        newcomer's, socket and state machine, is this one's from now on."""
        kept = self._writer.kept
        assert kept is not None
        self._memory.waiting.set(self, self.host, 0)
        transport = newcomer._give_to(self)
        self.asleep = self._lost = False
        self.peer, self.recipient = newcomer.peer, newcomer.peer.recipient
        self.entrance, self.host, self.address = newcomer.entrance, newcomer.host, newcomer.address
        newcomer.pace.has_left(self.pace)
        self.greeted_at, self.pace = newcomer.greeted_at, newcomer.pace
        self.drops.update(newcomer.drops)
        self._transport = transport
        self._outbox.limit_bytes = self._outbox_bytes
        again, gap = kept.again(received)
        resumed = to_agent(SessionResumed(self.agent_id, heard, gap))
        self._writer.wake(transport, resumed, again)
        self._account()
        if self._pauses:
            transport.pause_reading()
        self._looked, self._read_by = False, math.inf
        self._schedule()

    def _give_to(self, successor: Connection) -> asyncio.Transport:
        """What comes through this socket is another connection's from now on."""
        transport, self._transport = self._transport, ENDED
        self._successor = successor
        self._look_no_more()
        self._writer.detach()
        self._memory.unfinished.note(self, self.host, 0)
        self._memory.waiting.set(self, self.host, 0)
        transport.set_protocol(successor)
        if self._pauses and not transport.is_closing():
            transport.resume_reading()
        return transport

    def _give_up(self, reason: str) -> None:
        """Nothing comes of its socket: close it, unless the agent may come back over another. What waits for its turn
        was said before, and comes before its end or its sleep: robots stop then, and must not move again."""
        if self._waits:
            log.info("%s: %s", self, reason)
            self._transport.abort()
        elif not self.owner.sleeps(self):
            self.close(reason)

    def all_drops(self) -> Counter[str]:
        """Everything that was dropped for this agent, by name."""
        return sum(filter(None, (self.drops, self.peer.drops, self._outbox.drops)), Counter[str]())

    def _schedule(self) -> None:
        """Look again when time may have run out; sooner is never needed, and who looks too early looks again."""
        due = self.peer.next_deadline()
        paused_at = self._writer.paused_at
        if paused_at is not None:
            due = min(due, paused_at + self._write_timeout_s)
        now = time.monotonic()
        due = min(due, max(self.peer.heard_at + AWAY_S, now + LOOK_S))
        delay_s = max(0.0, due - now) + 0.001
        if self._unread > 0:
            delay_s = max(delay_s, READ_S)
        if self._timer is not None:
            if self._timer.when() <= self._loop.time() + delay_s:
                return
            self._timer.cancel()
        self._timer = self._loop.call_later(delay_s, self._tick)

    def _look_no_more(self) -> None:
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()

    def _tick(self) -> None:
        self._timer = None
        now = time.monotonic()
        in_time = now < self.peer.next_deadline()
        if in_time:
            self._looked = False  # what comes when its time has run out another time is looked at anew
        if in_time or not self._must_be_read():
            self.take(self.peer.tick(now), now)
        paused_at = None if self.asleep else self._writer.paused_at
        if paused_at is not None and now >= paused_at + self._write_timeout_s:
            self._give_up(f"it has not read for {self._write_timeout_s:g} s")
        elif self.is_away(now) and not self.asleep and is_gone(self._transport.get_extra_info("socket")):
            self._give_up("its host does not answer")
        if self.peer.state is not State.GONE and not self.asleep:
            self._schedule()

    @property
    def drives(self) -> bool:
        """Whether it has sent a robot a command a moment ago. Nobody who drives is held back for what else he sends,
        since his stop would wait behind that; what there is no room for is dropped."""
        return time.monotonic() < self.drove_at + DRIVES_S

    def is_away(self, now: float) -> bool:
        """Whether nothing was heard of the agent for a while, though it is online."""
        return self.asleep or now >= self.peer.heard_at + AWAY_S

    def _must_be_read(self) -> bool:
        """Whether the agent's time has run out, but not all of what it had sent by then was looked at: the loop may
        have been held up, or reading paused. What comes later does not count, so that nobody can put that off."""
        waiting, now = waiting_bytes(self._transport.get_extra_info("socket")), time.monotonic()
        if not self._looked:
            self._looked, self._unread, self._read_by = True, waiting + self._keeps_some, now + READ_WITHIN_S
        elif self._pauses:
            self._read_by = now + READ_WITHIN_S
        elif not waiting or now >= self._read_by:
            self._unread = 0
        if self._unread > 0:
            return True
        self._looked = False
        return False

    @property
    def _keeps_some(self) -> bool:
        """Whether some of what has come may be beyond the socket: in TLS, in a WebSocket, or with who is paused."""
        info = self._transport.get_extra_info
        return bool(self._pauses or info("ssl_object") or info("websocket"))
