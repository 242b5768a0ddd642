"""What rmw_zenoh attaches to each message, request and reply: a number, a time, and whose it is. 33 bytes."""

from __future__ import annotations

import importlib
import struct
from typing import NamedTuple

from macs_zenoh.errors import MissingExtra

GID_BYTES = 16
_LAYOUT = struct.Struct("<qqB16s")
ATTACHMENT_BYTES = _LAYOUT.size


class Attachment(NamedTuple):
    """``number`` counts from 1, ``time_ns`` is since the epoch, ``gid`` are 16 bytes: the endpoint's, or in a reply
    the one that asked."""

    number: int
    time_ns: int
    gid: bytes


def encode_attachment(number: int, time_ns: int, gid: bytes) -> bytes:
    """Always whole: one that is cut short ends the process of a ROS node that gets it."""
    if len(gid) != GID_BYTES:
        raise ValueError(f"a GID of {len(gid)} bytes, not {GID_BYTES}")
    return _LAYOUT.pack(number, time_ns, GID_BYTES, gid)


def parse_attachment(data: bytes) -> Attachment | None:
    """None when it is no attachment of rmw_zenoh's."""
    if len(data) != ATTACHMENT_BYTES:
        return None
    number, time_ns, size, gid = _LAYOUT.unpack(data)
    return Attachment(number, time_ns, gid) if size == GID_BYTES else None


def gid_of(token: str) -> bytes:
    """The 16 bytes by which ROS knows an endpoint: XXH3-128 of its token, the last byte first. Raises MissingExtra."""
    try:
        xxhash = importlib.import_module("xxhash")
    except ImportError as error:
        raise MissingExtra("being a ROS node without ROS", "xxhash", "rmw-zenoh") from error
    digest: bytes = xxhash.xxh3_128_digest(token.encode())
    return digest[::-1]
