"""What the first bytes of a connection say about who is there, for who has connected to the wrong port. Pure.

A gateway speaks first: a message with an id (protocol.md). A Zenoh router waits for an ``InitSyn`` and answers it,
with ``InitAck`` or ``Close``, in a batch: its size in two bytes, then messages whose first byte has their kind in its
lower five bits (Zenoh's protocol 9).
"""

from __future__ import annotations

from .messages import Welcome

INIT, CLOSE = 0x01, 0x03
ENOUGH_BYTES = 256
"""Neither says more before it is known."""

INIT_SYN = bytes.fromhex("1900 c1 09 f2") + b"macs: who is it?" + bytes.fromhex("0a c8ff 812701")
"""What a Zenoh client of version 1.10 says first, with a Zenoh id that nobody has."""


def is_gateway(first: bytes) -> bool:
    """Whether a MACS gateway or router said this to somebody who has said nothing that it could use."""
    size = int.from_bytes(first[:4], "little")
    return first[4:5] == b"{" and 2 <= size <= 4096 and Welcome.manager.encode() in first


def is_zenoh(first: bytes) -> bool:
    """Whether Zenoh said this, first or as the answer to an ``InitSyn``: a whole batch. (TLS says 15 03 03, too.)"""
    size = int.from_bytes(first[:2], "little")
    return 1 <= size <= len(first) - 2 and first[2] & 0x1F in (INIT, CLOSE)


def begins_as_client(first: bytes) -> bool:
    """Whether a Zenoh program dials a router here: one ``InitSyn`` and nothing more. No frame begins so."""
    whole = len(first) >= 4 and int.from_bytes(first[:2], "little") == len(first) - 2
    return whole and first[2] & 0x3F == INIT and first[3] < 0x20
