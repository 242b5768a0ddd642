"""CDR of std_msgs/String, which is all that our programs write and read themselves. Pure."""

from __future__ import annotations

import struct

HEADER = b"\x00\x01\x00\x00"
"""Plain CDR, little endian."""
_U32 = {b"\x00\x01": struct.Struct("<I"), b"\x00\x00": struct.Struct(">I")}


def written_text(text: bytes) -> bytes:
    """A std_msgs/String with this text in UTF-8, which has no zero."""
    return HEADER + _U32[b"\x00\x01"].pack(len(text) + 1) + text + b"\x00"


def read_text(cdr: bytes) -> bytes:
    """The text of a std_msgs/String. Raises ValueError."""
    size = _U32.get(bytes(cdr[:2]))
    if size is None or len(cdr) < len(HEADER) + size.size:
        raise ValueError("it is no CDR of a string")
    (length,) = size.unpack_from(cdr, len(HEADER))
    begin = len(HEADER) + size.size
    if length == 0:  # as some write an empty string
        return b""
    if begin + length > len(cdr) or cdr[begin + length - 1] != 0:
        raise ValueError("its string is cut off")
    return bytes(cdr[begin : begin + length - 1])


def looks_like_cdr(data: bytes) -> bool:
    """Whether bytes begin as plain CDR does. A ROS node that gets anything else ends."""
    return len(data) > len(HEADER) and bytes(data[:2]) in _U32
