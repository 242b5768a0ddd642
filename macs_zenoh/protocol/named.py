"""Messages between named agents: their form, who is there, and what is kept, limited or recognised. Pure.

Robots that are aware of each other send by name and by message type, a word that their modules agree on. `awareness`
puts these parts on the mesh; the keys are NAME, WANTED, NAMED, NAMED_ALL and LAST in `keyexpr`.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict, deque
from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Annotated, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

from ..errors import BadField, BadJson, UsageError
from .keyexpr import NAME, WANTED, type_name
from .limits import NESTING
from .rate import Rate
from .room import Room
from .wire import encode_message, split_message

_K = TypeVar("_K")
_V = TypeVar("_V")

LONGEST_NAME = 200
"""Characters in a name or message type: escaped they become at most twelve times as long, and are part of keys."""


class Outcome(Enum):
    """What is known about a message that was sent."""

    DELIVERED = "delivered"
    """Confirmed: a module of the receiver took it."""
    SENT = "sent"
    """The receiver is there and has the type registered."""
    NO_SUCH_AGENT = "no such agent"
    NOT_REGISTERED = "not registered"
    """The receiver is there (or, to all, others are), and nobody there has registered this type."""
    RATE_LIMITED = "rate limited"
    LATE = "late"
    """The receiver is there and has not confirmed it by the deadline."""
    NO_ROUTER = "no router"
    """This program has no connection to the mesh now."""
    KEPT = "kept"
    """The same, and the message is kept: who takes its type gets it when there is a router again."""
    TO_ITSELF = "to itself"

    @property
    def counter(self) -> str:
        """Its name among counters: ``no_such_agent``."""
        return self.value.replace(" ", "_")


class Envelope(msgspec.Struct, frozen=True, rename="camel", omit_defaults=True):
    """What travels with the data. ``session`` and ``number`` tell a message from a repetition of it."""

    session: Annotated[str, Meta(min_length=1, max_length=64)]
    """Of the sender's life: a restarted program has another."""
    number: Annotated[int, Meta(ge=0)]
    """Ascending within a session."""
    deadline_s: Annotated[float, Meta(gt=0)] | None = None
    """How long the message is worth delivering, from when it was sent."""


_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder(Envelope)


def encode(envelope: Envelope, data: bytes | bytearray | memoryview) -> bytes:
    """One message: envelope and data."""
    return encode_message(_encoder.encode(envelope), bytes(data))


def decode(payload: bytes) -> tuple[Envelope, bytes]:
    """Take a message apart. Raises BadSizes, TooLong, BadJson, BadField."""
    text, data = split_message(payload)
    if text.count(b"[") + text.count(b"{") > NESTING:  # it is flat; how deep Python follows differs by version
        raise BadJson("envelope", f"more than {NESTING} objects and lists")
    try:
        return _decoder.decode(text), bytes(data)
    except msgspec.ValidationError as error:
        raise BadField("envelope", str(error)) from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadJson("envelope", str(error)) from None


def check_word(what: str, word: str) -> None:
    """Raise UsageError when a name or a message type cannot be part of a key: empty, too long, no text."""
    if not word:
        raise UsageError(f"{what} is empty")
    if len(word) > LONGEST_NAME:
        raise UsageError(f"{what} has {len(word)} characters, at most {LONGEST_NAME} are allowed")
    try:
        word.encode()
    except UnicodeEncodeError:
        raise UsageError(f"{what} {word!r} is not valid text") from None


# -- who is there ----------------------------------------------------------------------------------------------------


class Named(NamedTuple):
    """An agent with a name. ``id`` 0: the name has no agent of its own; ``zid``: the session that declared it."""

    name: str
    type: int
    id: int
    zid: str

    @property
    def type_name(self) -> str:
        """``ros``, ``unity`` or the number."""
        return type_name(self.type)


class Names:
    """Everybody with a name, and which message types they take, as told by tokens.

    Without grace: who has lost the way to the others cannot reach them, and their tokens come back with the link.
    """

    NAMES, NAMES_IN_ALL = 64, 4096
    """Of one session, which has one as a rule."""
    TYPES, TYPES_IN_ALL = 1024, 64 << 10
    """Of one session; a robot's modules take tens."""
    SESSIONS = 16
    """That say the same."""

    def __init__(self, own: str = "", *, mine: str = "") -> None:
        """``own`` is the own name, of which it must be known that another has it; ``mine`` the own Zenoh id."""
        self._own = own
        self._room: Room[str] = Room(mine, sessions=self.SESSIONS, each=self.NAMES, total=self.NAMES_IN_ALL)
        self._room_for_types: Room[tuple[str, str]] = Room(
            mine, sessions=self.SESSIONS, each=self.TYPES, total=self.TYPES_IN_ALL
        )
        self._claims: dict[str, dict[str, Named]] = {}
        self._wanted: dict[str, dict[str, set[str]]] = {}

    def __iter__(self) -> Iterator[Named]:
        """Everybody, by name."""
        return (self._claims[name][max(self._claims[name])] for name in sorted(self._claims))

    def __contains__(self, name: object) -> bool:
        return name in self._claims

    def token(self, key: str, alive: bool) -> str | None:
        """A token appeared or ended: the name about which something has changed, or None."""
        if (claim := NAME.parse(key)) is not None:
            return self._claim(Named(*claim), alive)
        if (wanted := WANTED.parse(key)) is not None:
            return self._want(*wanted, alive)
        return None

    def knows(self, key: str) -> bool:
        """Whether a token's session is known to say this, whatever its id; so is what is no such key."""
        if (claim := NAME.parse(key)) is not None:
            return claim.zid in self._claims.get(claim.name, ())
        if (wanted := WANTED.parse(key)) is not None:
            return wanted.zid in self._wanted.get(wanted.name, {}).get(wanted.message_type, ())
        return True

    @property
    def left_out(self) -> int:
        """How often a token was one too many."""
        return self._room.left_out + self._room_for_types.left_out

    def has_room(self) -> bool:
        """Whether there may be room for something that was left out, since this was last asked."""
        return any([self._room.is_made(), self._room_for_types.is_made()])

    def claims(self) -> list[Named]:
        """Every claim, by name and session: a name that two agents have is listed twice."""
        return [claims[zid] for _, claims in sorted(self._claims.items()) for zid in sorted(claims)]

    def claimants(self, name: str) -> list[str]:
        """Sessions that hold a name: more than one is a conflict."""
        return sorted(self._claims.get(name, ()))

    def takes(self, name: str, message_type: str) -> bool:
        """Whether somebody at this agent has registered the type."""
        return bool(self._wanted.get(name, {}).get(message_type))

    def types(self, name: str) -> list[str]:
        """The message types that an agent takes."""
        return sorted(self._wanted.get(name, ()))

    def takers(self, message_type: str) -> Iterator[str]:
        """Everybody who takes a message type."""
        return (name for name, types in self._wanted.items() if message_type in types and name in self._claims)

    def _claim(self, agent: Named, alive: bool) -> str | None:
        claims = self._claims.get(agent.name, {})
        before = claims.get(agent.zid)
        if not alive:
            if before != agent:
                return None
            del claims[agent.zid]
            self._room.release(agent.name, agent.zid)
            if not claims:
                del self._claims[agent.name]
            return agent.name
        if before is None:
            out = self._room.take(agent.name, agent.zid, claims, always=agent.name == self._own and not claims)
            if out == agent.zid:
                return None
            claims.pop(out or "", None)
        self._claims.setdefault(agent.name, claims)[agent.zid] = agent
        return agent.name if before != agent else None

    def _want(self, name: str, message_type: str, zid: str, alive: bool) -> str | None:
        types = self._wanted.get(name, {})
        zids = types.get(message_type, set())
        if (zid in zids) == alive:
            return None
        if alive:
            out = self._room_for_types.take((name, message_type), zid, zids)
            if out == zid:
                return None
            zids.discard(out or "")
            zids.add(zid)
            self._wanted.setdefault(name, types)[message_type] = zids
            return name if len(zids) == 1 else None
        zids.discard(zid)
        self._room_for_types.release((name, message_type), zid)
        if zids:
            return None
        del types[message_type]
        if not types:
            del self._wanted[name]
        return name


# -- what is sent ----------------------------------------------------------------------------------------------------


class RateLimits:
    """At most so many messages per second of a type, for each receiver by itself; no bursts."""

    LIMIT = 4096

    def __init__(self, max_hz: Mapping[str, float]) -> None:
        self._max_hz = dict(max_hz)
        self._paces: dict[tuple[str, str], Rate] = {}

    def admit(self, message_type: str, receiver: str, now: float) -> bool:
        """Whether a message may be sent now; if so, it counts."""
        max_hz = self._max_hz.get(message_type)
        if max_hz is None:
            return True
        pace = self._paces.get((message_type, receiver))
        if pace is None:
            if len(self._paces) >= self.LIMIT:
                self._paces = {key: each for key, each in self._paces.items() if not each.allows(now)}
            pace = self._paces[message_type, receiver] = Rate(max_hz)
        if not pace.allows(now):
            return False
        pace.take(1, now)
        return True


class LastValues:
    """The last message to all of each type, for those who join later. The types longest unsent give way."""

    def __init__(self, limit_bytes: int = 16 << 20) -> None:
        self.limit_bytes = limit_bytes
        self.bytes = 0
        self._values: OrderedDict[str, bytes] = OrderedDict()

    def keep(self, message_type: str, payload: bytes) -> bool:
        """Remember it. False when it alone is above the limit: then nothing of this type is kept."""
        self.bytes -= len(self._values.pop(message_type, b""))
        if len(payload) > self.limit_bytes:
            return False
        while self.bytes + len(payload) > self.limit_bytes:
            self.bytes -= len(self._values.popitem(last=False)[1])
        self._values[message_type] = payload
        self.bytes += len(payload)
        return True

    def get(self, message_type: str) -> bytes | None:
        """The last one, if any."""
        return self._values.get(message_type)


# -- what arrives ----------------------------------------------------------------------------------------------------


class Arrivals:
    """Tells a message from a repetition of it, and a last value that is news from one that is not."""

    SENDERS = 1024
    NUMBERS = 1024

    def __init__(self) -> None:
        self._seen: OrderedDict[tuple[str, str], tuple[deque[int], set[int]]] = OrderedDict()
        self._newest: OrderedDict[tuple[str, str, str], int] = OrderedDict()

    def fresh(self, sender: str, message_type: str, envelope: Envelope) -> bool:
        """Whether this message has not been seen; from now on it has."""
        order, numbers = _touch(self._seen, (sender, envelope.session), (deque(), set()), self.SENDERS)
        if envelope.number in numbers:
            return False
        if len(order) >= self.NUMBERS:
            numbers.discard(order.popleft())
        order.append(envelope.number)
        numbers.add(envelope.number)
        key = (sender, message_type, envelope.session)
        newest = _touch(self._newest, key, envelope.number, 8 * self.SENDERS)
        self._newest[key] = max(newest, envelope.number)
        return True

    def knows(self, sender: str, message_type: str, envelope: Envelope) -> bool:
        """Whether a message of this type has come from this life of the sender."""
        return (sender, message_type, envelope.session) in self._newest

    def newer(self, sender: str, message_type: str, envelope: Envelope) -> bool:
        """Whether nothing newer of this type has come from this life of the sender."""
        return envelope.number > self._newest.get((sender, message_type, envelope.session), -1)


class Copies:
    """Recognises a message that comes on two paths, where it carries no number: each is passed on once.

    The n-th message of one content counts once, on whichever path it comes first; so equal messages that were sent
    twice are passed on twice, and a path that loses one is made up for by the other.
    """

    WINDOW_S = 10.0

    def __init__(self) -> None:
        self._counts: OrderedDict[tuple[str, str, bytes], dict[str, int]] = OrderedDict()
        self._times: deque[tuple[float, tuple[str, str, bytes]]] = deque()

    def first(self, path: str, sender: str, message_type: str, data: bytes, now: float) -> bool:
        """Whether this is the first copy of the message."""
        while self._times and self._times[0][0] < now - self.WINDOW_S:
            _, old = self._times.popleft()
            self._counts.pop(old, None)
        key = (sender, message_type, hashlib.blake2b(data, digest_size=16).digest())
        counts = self._counts.get(key)
        if counts is None:
            counts = self._counts[key] = {}
            self._times.append((now, key))
        before = max(counts.values(), default=0)
        counts[path] = counts.get(path, 0) + 1
        return counts[path] > before


def _touch(table: OrderedDict[_K, _V], key: _K, default: _V, limit: int) -> _V:
    """The value of a key, now the youngest; the oldest leave above the limit."""
    value = table.setdefault(key, default)
    table.move_to_end(key)
    if len(table) > limit:
        table.popitem(last=False)
    return value
