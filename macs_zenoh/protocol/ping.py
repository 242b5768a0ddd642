"""What a program tells whoever pings it, and how that is written. Pure."""

from __future__ import annotations

import msgspec

from ..config import MeshSettings
from ..errors import BadJson
from .limits import REQUEST_BYTES
from .wire import Buffer, encode_message, split_message

MOST_AWAY = 1000
"""So many agents that are away are named: an answer has a size."""


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
    drops: dict[str, int] = {}
    """What its session lost since it started, by name."""
    now: dict[str, int] = {}
    """What is so at this moment and should not be, by name: ``waiting_for_id`` connections of a gateway."""
    address: str = ""
    """Where headsets reach it, as HOST:PORT, when it is a gateway."""
    away: list[tuple[int, int]] = []
    """(type, id) of agents of a gateway that it has not heard of for a while, though they are connected."""


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
    )


def encode(said: Pong, echo: Buffer = b"") -> bytes:
    """The answer to a ping: one message, what is said and the bytes that came with the ping."""
    return encode_message(msgspec.json.encode(said), echo)


def decode(answer: bytes) -> tuple[Pong, bytes]:
    """Take an answer apart. Raises BadSizes, TooLong, BadJson."""
    metadata, echo = split_message(answer, REQUEST_BYTES)
    try:
        return msgspec.json.decode(metadata, type=Pong), bytes(echo)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadJson("the answer to a ping", str(error)) from None
