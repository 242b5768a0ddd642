"""The CDR of ``LocalGenericMessage``, by hand: two strings and bytes.

rclpy would make a Python object of each message, with a check for each field and a copy of the data, in the middle
of its way from robot to robot. Little endian only, as all of x86-64 and Arm writes it; `read` says where it is not.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

LITTLE_ENDIAN = b"\x00\x01"
_HEADER = LITTLE_ENDIAN + b"\x00\x00"
_SIZE = struct.Struct("<I")


class Local(NamedTuple):
    """The fields of a ``LocalGenericMessage``."""

    agent: str
    type: str
    data: bytes


def read(cdr: bytes) -> Local | None:
    """Take a message apart; None when it is not little endian. Raises ValueError when it is cut short or no text."""
    if cdr[:2] != LITTLE_ENDIAN:
        return None
    agent, at = _text(cdr, 4)
    kind, at = _text(cdr, at)
    data, _ = _block(cdr, at)
    return Local(agent, kind, data)


def write(agent: str, message_type: str, data: bytes) -> bytes:
    """The CDR of a message."""
    return b"".join((_HEADER, _string(agent), _string(message_type), _SIZE.pack(len(data)), data))


def _block(cdr: bytes, at: int) -> tuple[bytes, int]:
    """A size and so many bytes; where the next size is (sizes are aligned to 4)."""
    try:
        (size,) = _SIZE.unpack_from(cdr, at)
    except struct.error:
        raise ValueError(f"a size is missing at byte {at}") from None
    end = at + 4 + size
    if end > len(cdr):
        raise ValueError(f"{size} bytes declared at byte {at}, {len(cdr) - at - 4} there")
    return cdr[at + 4 : end], (end + 3) & ~3


def _text(cdr: bytes, at: int) -> tuple[str, int]:
    text, at = _block(cdr, at)
    return text.rstrip(b"\0").decode(), at


def _string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return _SIZE.pack(len(data)) + data + bytes(-len(data) % 4)
