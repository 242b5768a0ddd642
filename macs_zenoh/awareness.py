"""Collective awareness for programs on the mesh: typed messages between agents by name. Asyncio.

::

    async with macs_zenoh.join("unity", connect=["tcp/127.0.0.1:7447"]) as agent:
        async with awareness.join(agent, "ground") as ground:
            ground.register("planning", lambda message: print(message.sender, message.data))
            ground.send("drone0", "planning", data)                    # by name
            ground.send("", "planning", data)                          # to everybody who takes this type
            outcome = await ground.deliver("drone0", "planning", data, deadline_s=2)    # until it is confirmed

Robots whose modules speak ROS take part through `bridge.awareness`; their data is then CDR.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

from .agent import Agent
from .anew import Anew
from .claims import settle, stale_until
from .errors import Refused, Unreachable, UsageError, WireError
from .handles import Callbacks, Handle
from .losses import Losses
from .mesh import Mesh, Sample, Subscription, Token, Traffic
from .mesh.followed import Followed
from .protocol import named
from .protocol.agent_id import AgentId
from .protocol.keyexpr import LAST, NAME, NAMED, NAMED_ALL, WANTED
from .protocol.limits import CALL_BYTES
from .protocol.named import Arrivals, Envelope, LastValues, Named, Names, Outcome, RateLimits, check_word
from .protocol.wire import PROBE
from .timeouts import within

log = logging.getLogger("macs.awareness")

ATTEMPT_S = 0.05
"""Pause before a message is offered again to a receiver that did not take it and about which nothing has changed."""

ASK_S = 2.0
"""How long another agent may take to tell its last value."""

MAX_MESSAGE_BYTES = 32 * 1024 * 1024


class Received(NamedTuple):
    """A message as a callback gets it."""

    sender: str
    """The sender's name, from the key: a router can hold senders to it."""
    type: str
    data: bytes
    to_all: bool
    """Whether it was sent to everybody."""
    good_until: float | None
    """In ``time.monotonic()``: when its deadline is over, counted from its arrival here."""


OnMessage = Callable[[Received], None]


class Registration:
    """One callback for one message type, until `close`."""

    def __init__(self, owner: Awareness, message_type: str, callback: OnMessage) -> None:
        self.type = message_type
        self.callback = callback
        self._owner: Awareness | None = owner

    def close(self) -> None:
        """Take no more messages. Closing twice is allowed."""
        if self._owner is not None:
            self._owner._unregister(self)
            self._owner = None


class Awareness:
    """One name on the mesh. Made by `join`; all methods belong to the mesh's event loop, except `send`.

    ``counters`` counts what was sent by `Outcome.counter`, and what arrived: ``received``, ``unregistered`` (sent here
    by name, and nobody here takes this type), ``repeated``, ``bad_message``, ``last_values`` (asked for and news),
    ``too_large``, ``name_taken_twice``, ``too_many_names`` (tokens of names and types).
    """

    KEYS = 4096
    """Keys that are remembered rather than built for each message."""

    def __init__(
        self,
        mesh: Mesh,
        name: str,
        *,
        agent_type: int,
        agent_id: int = 0,
        max_hz: Mapping[str, float] | None = None,
        cache: Mapping[str, int] | None = None,
        max_bytes: int = MAX_MESSAGE_BYTES,
    ) -> None:
        check_word("agent name", name)
        self.mesh = mesh
        self.name = name
        self.agent_type = agent_type
        self.agent_id = agent_id
        self.max_bytes = max_bytes
        self.names = Names(name, mine=mesh.zid)
        self.counters = Losses(log)
        self._lock = threading.Lock()
        self._keys: dict[tuple[str, str], str] = {}
        self._rates = RateLimits(max_hz or {})
        self._cache = dict(cache or {})
        self._last = LastValues()
        self._arrivals = Arrivals()
        self._number = 0
        self._callbacks: dict[str, list[Registration]] = {}
        self._declared: list[Subscription] = []
        self._token_of_name = Token()
        self._per_type: dict[str, list[Subscription]] = {}
        self._asking: set[str] = set()
        self._rivals: set[str] = set()
        self._on_change: Callbacks[Callable[[str], None]] = Callbacks()
        self._changed = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._anew = Anew(mesh, [NAME.every(), WANTED.every()], self._again)

    def __repr__(self) -> str:
        return f"<Awareness {self.name!r} {AgentId(self.agent_type, self.agent_id)}>"

    # -- who is there --------------------------------------------------------------------------------------------

    def others(self) -> list[Named]:
        """Everybody with a name except this one."""
        return [agent for agent in self.names if agent.name != self.name]

    def on_change(self, callback: Callable[[str], None]) -> Handle:
        """Call ``callback(name)`` when an agent comes, leaves, or takes other types than before."""
        return self._on_change.add(callback)

    async def wait_for(self, name: str, message_type: str | None = None, *, timeout_s: float) -> None:
        """Wait until an agent is there (and takes a type). Raises Unreachable."""
        deadline = time.monotonic() + timeout_s
        while name not in self.names or not (message_type is None or self.names.takes(name, message_type)):
            if not await self._change_before(deadline):
                what = f"it has not registered {message_type!r}" if name in self.names else "no agent has this name"
                raise Unreachable(repr(name), what)

    # -- send ----------------------------------------------------------------------------------------------------

    def send(
        self, receiver: str, message_type: str, data: bytes | bytearray, *, deadline_s: float | None = None
    ) -> Outcome:
        """Send to one agent, or with an empty receiver to every other agent that takes the type. From any thread.

        It returns at once. Not being there or not having registered is what is known now: the message is put all the
        same, for whoever registers at this moment. Raises UsageError: a name or type that is none, or too much data.
        """
        self._check(receiver, message_type, len(data))
        if receiver == self.name:
            return self._count(Outcome.TO_ITSELF)
        with self._lock:
            if not self._rates.admit(message_type, receiver, time.monotonic()):
                outcome = Outcome.RATE_LIMITED
            else:
                payload = self._encode(data, deadline_s)
                if not receiver:
                    self._last.keep(message_type, payload)
                if self.mesh.linked:
                    outcome = self._expected(receiver, message_type)
                else:
                    outcome = Outcome.KEPT if not receiver and message_type in self._cache else Outcome.NO_ROUTER
        if outcome not in (Outcome.RATE_LIMITED, Outcome.NO_ROUTER):
            self.mesh.put(self._key(receiver, message_type), payload, Traffic.CALL)
        return self._count(outcome)

    async def deliver(
        self, receiver: str, message_type: str, data: bytes | bytearray, *, deadline_s: float
    ) -> Outcome:
        """Send to one agent until it confirms that somebody there took the message, or the deadline is over.

        It may wait for the agent to come, for a registration and for a router. The receiver takes it once, however
        often it was repeated. Raises UsageError like `send`.
        """
        if not receiver:
            raise UsageError("deliver to whom? A message to all has nobody who confirms it; use send")
        self._check(receiver, message_type, len(data))
        if receiver == self.name:
            return self._count(Outcome.TO_ITSELF)
        with self._lock:
            admitted = self._rates.admit(message_type, receiver, time.monotonic())
            payload = self._encode(data, deadline_s)
        if not admitted:
            return self._count(Outcome.RATE_LIMITED)
        deadline = time.monotonic() + deadline_s
        key = self._key(receiver, message_type)
        while True:
            try:
                await self.mesh.query(key, payload, timeout_s=max(0.001, deadline - time.monotonic()))
            except Refused:
                outcome = Outcome.NOT_REGISTERED
            except Unreachable:
                outcome = self._why_not(receiver)
            else:
                return self._count(Outcome.DELIVERED)
            if time.monotonic() >= deadline:
                return self._count(outcome)
            # what is there may take a moment to be served; what is not there can only change by a token
            here = receiver in self.names and self.names.takes(receiver, message_type)
            await self._change_before(min(deadline, time.monotonic() + ATTEMPT_S) if here else deadline)
            if time.monotonic() >= deadline:
                return self._count(outcome)

    def _check(self, receiver: str, message_type: str, size: int) -> None:
        if receiver:
            check_word("receiver", receiver)
        check_word("message type", message_type)
        if size > self.max_bytes:
            self.counters["too_large"] += 1
            raise UsageError(f"a message of {size} bytes is above the limit of {self.max_bytes}")

    def _key(self, receiver: str, message_type: str) -> str:
        key = self._keys.get((receiver, message_type))
        if key is None:
            if receiver:
                key = NAMED.of(name=receiver, message_type=message_type, from_name=self.name)
            else:
                key = NAMED_ALL.of(message_type=message_type, from_name=self.name)
                if message_type in self._cache:
                    self.mesh.keep(key, self._cache[message_type])
            if len(self._keys) >= self.KEYS:
                self._keys.clear()
            self._keys[receiver, message_type] = key
        return key

    def _encode(self, data: bytes | bytearray, deadline_s: float | None) -> bytes:
        self._number += 1
        return named.encode(Envelope(self.mesh.zid, self._number, deadline_s), data)

    def _expected(self, receiver: str, message_type: str) -> Outcome:
        if receiver and receiver not in self.names:
            return Outcome.NO_SUCH_AGENT
        if receiver:
            taken = self.names.takes(receiver, message_type)
        else:
            taken = any(name != self.name for name in self.names.takers(message_type))
        return Outcome.SENT if taken else Outcome.NOT_REGISTERED

    def _why_not(self, receiver: str) -> Outcome:
        if not self.mesh.linked:
            return Outcome.NO_ROUTER
        return Outcome.LATE if receiver in self.names else Outcome.NO_SUCH_AGENT

    def _count(self, outcome: Outcome) -> Outcome:
        with self._lock:
            self.counters[outcome.counter] += 1
        return outcome

    # -- receive -------------------------------------------------------------------------------------------------

    def register(self, message_type: str, callback: OnMessage, *, last_value: bool = False) -> Registration:
        """Call ``callback`` for each message of a type, sent to this name or to all, until the registration is closed.

        ``last_value`` asks every other agent, those here now and those that come, for its last message to all.
        """
        check_word("message type", message_type)
        registration = Registration(self, message_type, callback)
        first = message_type not in self._callbacks
        self._callbacks.setdefault(message_type, []).append(registration)
        if first:
            self._per_type[message_type] = [
                self.mesh.subscribe(NAMED_ALL.every(message_type=message_type), self._receive_all, reliable=True),
                self.mesh.declare_token(WANTED.of(name=self.name, message_type=message_type, zid=self.mesh.zid)),
            ]
        if last_value:
            self._asking.add(message_type)
            for agent in self.others():
                self._ask(agent.name, message_type)
        return registration

    def _unregister(self, registration: Registration) -> None:
        registered = self._callbacks.get(registration.type, [])
        if registration in registered:
            registered.remove(registration)
        if not registered:
            self._callbacks.pop(registration.type, None)
            self._asking.discard(registration.type)
            for declared in self._per_type.pop(registration.type, []):
                declared.close()

    def _receive(self, batch: Iterator[Sample]) -> None:
        for key, payload in batch:
            fields = NAMED.parse(key)
            if fields is not None:
                self._take(fields.from_name, fields.message_type, bytes(payload), to_all=False)

    def _receive_all(self, batch: Iterator[Sample]) -> None:
        for key, payload in batch:
            fields = NAMED_ALL.parse(key)
            if fields is not None and fields.from_name != self.name:
                self._take(fields.from_name, fields.message_type, bytes(payload), to_all=True)

    async def _confirm(self, key: str, payload: bytes) -> bytes:
        fields = NAMED.parse(key)
        if fields is None:
            raise Refused(f"{key} names no sender")
        if not self._take(fields.from_name, fields.message_type, payload, to_all=False):
            raise Refused(f"nobody at {self.name} has registered {fields.message_type}")
        return b""

    def _take(self, sender: str, message_type: str, payload: bytes, *, to_all: bool, last: bool = False) -> bool:
        """Pass a message on; whether somebody takes its type. A repetition is taken and not passed on."""
        if payload.startswith(PROBE):
            return False
        try:
            envelope, data = named.decode(payload)
        except WireError as error:
            self._lose("bad_message", sender, f"a message from {sender} cannot be used: {error}")
            return True  # sending it again would not help
        registered = self._callbacks.get(message_type)
        if not registered:
            self._lose("unregistered", message_type, f"nobody here has registered {message_type!r}; {sender} sent one")
            return False
        if last and not self._arrivals.newer(sender, message_type, envelope):
            return True
        if last and message_type in self._cache and self._arrivals.knows(sender, message_type, envelope):
            return True  # it comes in its turn, behind others that were missed
        if not self._arrivals.fresh(sender, message_type, envelope):
            self.counters["repeated"] += 1
            return True
        self.counters["last_values" if last else "received"] += 1
        good_until = time.monotonic() + envelope.deadline_s if envelope.deadline_s is not None else None
        message = Received(sender, message_type, data, to_all, good_until)
        for registration in list(registered):
            try:
                registration.callback(message)
            except Exception:
                # one module that fails must not cost the others their message
                log.exception("the callback for %r failed", message_type)
        return True

    def _lose(self, counter: str, about: str, text: str) -> None:
        self.counters.once(counter, "%s", text, about=about)

    # -- last values ---------------------------------------------------------------------------------------------

    def _ask(self, name: str, message_type: str) -> None:
        self._spawn(self._ask_for_last(name, message_type))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _ask_for_last(self, name: str, message_type: str) -> None:
        key = LAST.of(name=name, message_type=message_type, from_name=self.name)
        deadline = time.monotonic() + ASK_S
        while (left := deadline - time.monotonic()) > 0:
            try:
                payload = await self.mesh.query(key, b"", timeout_s=left)
            except Refused:
                return  # it has sent none
            except Unreachable:
                await asyncio.sleep(min(left, ATTEMPT_S))  # it is there a moment before it serves
                continue
            if message_type in self._callbacks:
                self._take(name, message_type, payload, to_all=True, last=True)
            return
        log.debug("%s did not tell its last %s", name, message_type)

    async def _tell_last(self, key: str, _payload: bytes) -> bytes:
        fields = LAST.parse(key)
        value = self._last.get(fields.message_type) if fields is not None else None
        if value is None:
            raise Refused("no such message was sent to all")
        return value

    # -- life ----------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Claim the name and listen. Raises UsageError when somebody else has it."""
        own = NAME.every(name=self.name)
        followed = Followed(await self.mesh.tokens(own), self._token)
        self._keep(self.mesh.watch_tokens(NAME.every(), followed.told))
        self._spawn(followed.confirm(lambda: self.mesh.tokens(own)))
        self._keep(self.mesh.watch_tokens(WANTED.every(), self._token))
        await self._wait_for_stale()
        if self.names.claimants(self.name):
            raise UsageError(f"an agent called {self.name!r} is already on the mesh; choose another name")
        self._keep(self.mesh.subscribe(NAMED.every(name=self.name), self._receive))
        self._keep(self.mesh.serve(NAMED.every(name=self.name), self._confirm))
        self._keep(self.mesh.serve(LAST.every(name=self.name), self._tell_last, most_bytes=CALL_BYTES))
        self._keep(self._token_of_name)
        self._token_of_name.become(self._declare_name())
        if not await settle(self.mesh.zid, lambda: self.names.claimants(self.name)):
            raise UsageError(f"another agent took the name {self.name!r} in this moment; choose another")

    async def _wait_for_stale(self) -> None:
        """Give the token of an earlier life of this agent the time of a lease to end."""
        deadline = stale_until(self.mesh.settings)
        while self.names.claimants(self.name):
            if not await self._change_before(deadline):
                return

    def change_id(self, agent_id: int) -> None:
        """The agent with this name has another id now."""
        self.agent_id = agent_id
        if self._token_of_name.is_open:
            self._token_of_name.become(self._declare_name())  # which is there before the old one ends

    def _declare_name(self) -> Token:
        key = NAME.of(name=self.name, type=self.agent_type, id=self.agent_id, zid=self.mesh.zid)
        return self.mesh.declare_token(key)

    def close(self) -> None:
        """Leave: the name is free at once. The mesh stays open."""
        self._anew.close()
        for task in self._tasks:
            task.cancel()
        for declared in reversed([*self._declared, *(d for per_type in self._per_type.values() for d in per_type)]):
            declared.close()
        self._declared.clear()
        self._per_type.clear()
        self._callbacks.clear()

    def _keep(self, declared: Subscription) -> None:
        self._declared.append(declared)

    def _token(self, key: str, alive: bool) -> None:
        if not alive:
            self._anew.ended(key)
        with self._lock:
            left_out, name = self.names.left_out, self.names.token(key, alive)
        if self.names.left_out != left_out:
            self._lose("too_many_names", "", "more names, or types of one session, than are remembered")
        if self.names.has_room():
            self._anew.ask()
        if name is None:
            return
        self._changed.set()
        if name == self.name:
            if alive:
                self._check_name()
            return
        if alive and NAME.parse(key) is not None:
            for message_type in self._asking:
                self._ask(name, message_type)
        for callback in self._on_change:
            callback(name)

    def _again(self, keys: Sequence[str]) -> None:
        for key in keys:
            if not self.names.knows(key):
                self._token(key, True)

    def _check_name(self) -> None:
        """Tell once when another agent has our name, each by itself: both were given it, and keep it.

        That happens only where two parts of a mesh have met again: who joins sees the name that is there.
        """
        for other in self.names.claimants(self.name):
            if other != self.mesh.zid and other not in self._rivals:
                self._rivals.add(other)
                text = "session %s is called %r as well; both get its messages. Rename one"
                self.counters.once("name_taken_twice", text, other, self.name, about=other, level=logging.ERROR)

    async def _change_before(self, deadline: float) -> bool:
        """Wait for a token to come or go; False when the deadline was earlier."""
        self._changed.clear()
        try:
            await within(self._changed.wait(), max(0.0, deadline - time.monotonic()))
        except asyncio.TimeoutError:
            return False
        return True


@asynccontextmanager
async def join(
    agent: Agent,
    name: str,
    *,
    max_hz: Mapping[str, float] | None = None,
    cache: Mapping[str, int] | None = None,
    max_bytes: int = MAX_MESSAGE_BYTES,
) -> AsyncIterator[Awareness]:
    """Give an agent a name that others send to, until the end of the block.

    Args:
        agent: made by `macs_zenoh.join`; its type and id are what `macs ls` shows with the name.
        name: any text of 1 to 200 characters that nobody else on the mesh has.
        max_hz: per message type, how many messages per second may be sent to each receiver.
        cache: per message type, how many messages to all are kept for agents that miss some (docs/reliable.md).
        max_bytes: what is larger is refused by `send` and `deliver`.

    Raises UsageError: the name is taken or cannot be one.
    """
    awareness = Awareness(
        agent.mesh,
        name,
        agent_type=agent.type_number,
        agent_id=agent.id,
        max_hz=max_hz,
        cache=cache,
        max_bytes=max_bytes,
    )
    following_id = agent.on_id(lambda old, new: awareness.change_id(new))
    try:
        await awareness.start()
        yield awareness
    finally:
        following_id.close()
        awareness.close()
