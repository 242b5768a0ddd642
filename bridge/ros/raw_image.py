"""sensor_msgs/Image and CompressedImage as CDR: what of them is needed to make the one from the other. Pure."""

from __future__ import annotations

import struct
from typing import NamedTuple

from macs_zenoh.errors import WireError

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

_BEGIN = 4
"""Bytes that say how the rest is written; alignment counts from behind them."""
_STAMP_BYTES = 8
MOST_PIXELS = 1 << 26


class NotAnImage(WireError):
    """Bytes that are no image that can be read; the text says why."""


class RawImage(NamedTuple):
    """``data`` has ``step`` bytes per row. ``stamp`` is 8 bytes as they come, ``frame`` its frame_id."""

    stamp: bytes
    frame: bytes
    height: int
    width: int
    encoding: str
    big_endian: bool
    step: int
    data: memoryview


def read_image(cdr: bytes | memoryview) -> RawImage:
    """An Image; its data is not copied. Raises NotAnImage."""
    view = memoryview(cdr)
    if len(view) < _BEGIN or view[0] or view[1] > 1:
        raise NotAnImage("it is not written as ROS 2 writes it")
    order = "<" if view[1] else ">"
    try:
        at = _BEGIN + _STAMP_BYTES
        stamp = struct.unpack_from(f"{order}iI", view, _BEGIN)
        frame, at = _text(view, at, order)
        height, width = struct.unpack_from(f"{order}II", view, at := _aligned(at))
        encoding, at = _text(view, at + 8, order)
        big_endian = view[at] != 0
        step, size = struct.unpack_from(f"{order}II", view, at := _aligned(at + 1))
    except (struct.error, IndexError) as error:
        raise NotAnImage("it ends too soon") from error
    data = view[at + 8 : at + 8 + size]
    if len(data) < size or size < step * height:
        raise NotAnImage(f"{height} rows of {step} bytes are more than the {len(data)} that it has")
    if not 0 < width * height <= MOST_PIXELS:
        raise NotAnImage(f"it is {width} x {height} pixels large")
    name = bytes(encoding).decode("ascii", "replace")
    return RawImage(struct.pack("<iI", *stamp), bytes(frame), height, width, name, big_endian, step, data)


def write_compressed(image: RawImage, form: str, data: bytes) -> bytes:
    """A CompressedImage with the stamp and frame of an image."""
    head = bytearray(b"\x00\x01\x00\x00" + image.stamp)
    for text in (image.frame, form.encode()):
        head += b"\0" * (_aligned(len(head)) - len(head))
        head += struct.pack("<I", len(text) + 1) + text + b"\0"
    head += b"\0" * (_aligned(len(head)) - len(head))
    return bytes(head) + struct.pack("<I", len(data)) + data


def _text(view: memoryview, at: int, order: str) -> tuple[memoryview, int]:
    """A text without the zero at its end, and where what follows begins."""
    (size,) = struct.unpack_from(f"{order}I", view, at := _aligned(at))
    at += 4
    if at + size > len(view):
        raise NotAnImage("it ends too soon")
    return view[at : at + max(0, size - 1)], at + size


def _aligned(at: int) -> int:
    return (at + 3) // 4 * 4
