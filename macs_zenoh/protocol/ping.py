"""What a program tells whoever pings it, and how that is written. Pure."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from itertools import islice

import msgspec

from ..config import MeshSettings
from ..errors import BadJson, TooLong
from .credit import Credit
from .limits import REQUEST_BYTES
from .messages import Count
from .wire import Buffer, encode_message, split_message

MOST_AWAY = 1000
"""So many agents that are away are named: an answer has a size."""


AGENTS = b"macs: which agents are yours?"
"""Sent with a ping it is answered by a gateway with its agents, in the place of the same bytes."""
MOST_AGENTS = 2000
AGENTS_BYTES = 512 << 10


PINGS_PER_S = 100
PING_BYTES_PER_S = 32 << 20
"""So many pings a program answers, with so much to send back. Who asks is not in the key: all have it together."""


class PingGate:
    """What pings have to pass. From any thread."""

    def __init__(self, now: float, on_dropped: Callable[[], object]) -> None:
        self._on_dropped = on_dropped
        self._pings = Credit(PINGS_PER_S, now)
        self._bytes = Credit(PING_BYTES_PER_S, now)
        self._lock = threading.Lock()

    def admits(self, key: str, size: int, urgent: bool, now: float) -> bool:
        """Whether a ping is answered."""
        with self._lock:
            admitted = self._pings.take(1, now) and self._bytes.take(size, now)
        if not admitted:
            self._on_dropped()
        return admitted


class GatewayAgent(msgspec.Struct, frozen=True, array_like=True):
    """An agent as its gateway knows it: where it comes from, and by which token."""

    type: int
    id: int
    address: str = ""
    token: str = ""
    age_s: float = 0.0
    """For how long it has been connected."""


class Pong(msgspec.Struct, frozen=True, kw_only=True):
    """One program, as it says itself. Fields that it does not know, or that we do not, are left out."""

    time_s: float
    """Its wall clock when it answered, in seconds since 1970."""
    macs: str = ""
    """Version of macs-zenoh."""
    zenoh: str = ""
    """Version of the eclipse-zenoh wheel."""
    mode: str = "client"
    shared_memory: bool = False
    lease_ms: int = 0
    id_slots: int = 0
    group_slots: int = 0
    """Slots in its frame headers: the same on a whole mesh."""
    drops: dict[str, Count] = {}
    """What its session lost since it started, by name."""
    now: dict[str, Count] = {}
    """What is so at this moment and should not be, by name: ``waiting_for_id`` connections of a gateway."""
    address: str = ""
    """Where headsets reach it, as HOST:PORT, when it is a gateway."""
    away: list[tuple[int, int]] = []
    """(type, id) of agents of a gateway that it has not heard of for a while, though they are connected."""
    link_bytes: tuple[Count, Count] | None = None
    """What its links to routers have sent and received since they came about, as its kernel counts."""


def pong(
    settings: MeshSettings,
    *,
    now_s: float,
    macs: str,
    zenoh: str,
    drops: dict[str, int],
    now: dict[str, int],
    away: list[tuple[int, int]],
    address: str = "",
    link_bytes: tuple[int, int] | None = None,
) -> Pong:
    """What a program with these settings says of itself."""
    return Pong(
        time_s=now_s,
        macs=macs,
        zenoh=zenoh,
        mode=settings.mode,
        shared_memory=settings.shared_memory,
        lease_ms=settings.lease_ms,
        id_slots=settings.id_slots,
        group_slots=settings.group_slots,
        drops=drops,
        now=now,
        away=away[:MOST_AWAY],
        address=address,
        link_bytes=link_bytes,
    )


def encode(said: Pong, echo: Buffer = b"") -> bytes:
    """The answer to a ping: one message, what is said and the bytes that came with the ping."""
    return encode_message(msgspec.json.encode(said), echo)


class GatewayTold(msgspec.Struct, frozen=True):
    """What a gateway answers to `AGENTS`: its agents, and what was lost and refused there, by name."""

    agents: list[GatewayAgent] = []
    lost: dict[str, Count] = {}


def encode_told(agents: Iterable[GatewayAgent], lost: Mapping[str, int]) -> bytes:
    """The answer to `AGENTS`."""
    return msgspec.json.encode(GatewayTold(list(islice(agents, MOST_AGENTS)), dict(lost)))


def decode_told(told: bytes) -> GatewayTold:
    """What a gateway told; nothing of one that has only sent the question back. Raises TooLong, BadJson."""
    if told == AGENTS or not told:
        return GatewayTold()
    if len(told) > AGENTS_BYTES:
        raise TooLong("what a gateway tells of its agents", len(told), AGENTS_BYTES)
    try:
        return msgspec.json.decode(told, type=GatewayTold)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadJson("what a gateway tells of its agents", str(error)) from None


def decode(answer: bytes) -> tuple[Pong, bytes]:
    """Take an answer apart. Raises BadSizes, TooLong, BadJson."""
    metadata, echo = split_message(answer, REQUEST_BYTES)
    try:
        return msgspec.json.decode(metadata, type=Pong), bytes(echo)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadJson("the answer to a ping", str(error)) from None
