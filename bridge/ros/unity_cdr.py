"""What Unity's serializer writes and reads otherwise than ROS 2 does: CDR from the one to the other. Pure.

Existing headsets use the serializer of Unity's ROS-TCP-Connector. It agrees with ROS (Fast CDR 2) in all but three:

* a structure without fields takes no bytes; in ROS it takes one, which is zero (std_msgs/Empty, a Trigger's request)
* before the items of a sequence it aligns to their size, also when there are none; ROS does not, then (a JointState
  without velocities: what follows is 4 bytes further on, and reading it there goes beyond the end)
* it writes a wstring as it writes a string; in ROS the length counts UTF-16 code units, which take 4 bytes each

Existing headsets go deaf on a message that ends before they have read it, and a robot that reads what they wrote as
ROS's own finds other numbers in it, so types that have any of the three are translated. Most have none.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from bridge.ros.shapes import Array, Number, Sequence, Shape, Structure, Text
from macs_zenoh.protocol.limits import REQUEST_BYTES

HEADER = b"\x00\x01\x00\x00"
"""Plain CDR, little endian: all that Unity's serializer knows."""
_HEADER_BYTES = len(HEADER)
_LARGE = 8
"""Items so large are aligned to more than the length before them."""
_MAX_NOTHINGS = 65536
"""Structures without fields in one sequence: in Unity's form they take no bytes, so their number bounds nothing."""

PARTS = 1 << 15
"""What a message may consist of, unless the settings say otherwise: about 0.1 s to translate."""
_FEW_BYTES = REQUEST_BYTES
"""What is not larger has few parts."""
_LETTERS = 32
"""So many letters of a wstring cost as much as one part."""
_OBJECTS = 64
"""So many items of which Python makes an object each, as of bool[], cost as much as one part."""

_U32 = struct.Struct("<I")
_Part = Callable[["_Copy"], None]


class Misfit(Exception):
    """The bytes are not of this type, or not in this form."""


class TooManyParts(Exception):
    """What somebody sent takes too long to translate or to read."""


class UnityCdr:
    """The two forms of one type. Made by `of`."""

    def __init__(self, copy: _Part) -> None:
        self._copy = copy

    @staticmethod
    def of(message: Structure) -> UnityCdr | None:
        """For a type, or None when Unity's serializer and ROS agree on it."""
        return UnityCdr(_structure(message)) if _differs(message) else None

    def to_ros(self, cdr: bytes, most: int = PARTS) -> bytes:
        """A headset's message as ROS reads it; unchanged when ROS reads it as it is, or nobody does.

        Who wrote it is not asked: bytes that are whole in the one form end too late or too early in the other. Where
        both fit, they are ROS's. Raises TooManyParts.
        """
        too_many: TooManyParts | None = None
        try:
            self._copied(cdr, from_unity=False, to_unity=False, most=most)
            return cdr
        except Misfit:
            pass
        except TooManyParts as error:  # in the other form the same bytes may be few numbers
            too_many = error
        try:
            return self._copied(cdr, from_unity=True, to_unity=False, most=most)
        except Misfit:
            if too_many is not None:
                raise too_many from None
            return cdr

    def to_unity(self, cdr: bytes) -> bytes | None:
        """ROS's message as an existing headset reads it; None when it is not of this type."""
        try:
            return self._copied(cdr, from_unity=False, to_unity=True, strict=False)
        except Misfit:
            return None

    def _copied(
        self, cdr: bytes, *, from_unity: bool, to_unity: bool, strict: bool = True, most: int | None = None
    ) -> bytes:
        if cdr[:_HEADER_BYTES] != HEADER:
            raise Misfit
        copy = _Copy(cdr, from_unity=from_unity, to_unity=to_unity, strict=strict, most=most)
        self._copy(copy)
        copy.end()
        return bytes(copy.out)


class Parts:
    """Bounds what it takes to read messages of one type as Python objects: not bytes, of which an array of numbers has
    many, but strings and structures. Made by `of`."""

    def __init__(self, copy: _Part) -> None:
        self._copy = copy

    @staticmethod
    def of(message: Structure) -> Parts | None:
        """For a type, or None when no message of it has many."""
        return Parts(_structure(message)) if _may_have_many(message) else None

    def check(self, cdr: bytes, most: int = PARTS) -> None:
        """Raises TooManyParts, also for what is too large to be read without knowing."""
        if len(cdr) <= _FEW_BYTES:
            return
        try:
            if cdr[:_HEADER_BYTES] != HEADER:
                raise Misfit
            self._copy(_Copy(cdr, from_unity=False, to_unity=False, strict=False, most=most))
        except Misfit:
            raise TooManyParts(f"{len(cdr)} bytes, and their parts cannot be counted") from None


def to_ros(both: UnityCdr | None, cdr: bytes, most: int = PARTS) -> bytes:
    """A headset's message as ROS reads it, of a type on which both may agree. Raises TooManyParts."""
    return cdr if both is None else both.to_ros(cdr, most)


def readable(both: UnityCdr | None, parts: Parts | None, cdr: bytes, most: int = PARTS) -> bytes:
    """A headset's message as ROS reads it, one that Python can read soon. Raises TooManyParts."""
    cdr = to_ros(both, cdr, most)
    if parts is not None:
        parts.check(cdr, most)
    return cdr


def to_unity(both: UnityCdr | None, cdr: bytes) -> bytes:
    """ROS's message as an existing headset reads it. What is not of its type, ROS has not made: it stays as it is.

    One without fields keeps the byte that it has in ROS. The headset reads none of it, and gateways, which know few
    types, take one that ends behind its header for one that is cut short.
    """
    unity = both.to_unity(cdr) if both is not None else None
    if unity is None:
        return cdr
    return unity + b"\0" if unity == HEADER else unity


def behind_a_byte(message: Structure, cdr: bytes) -> tuple[int, bytes]:
    """ROS's CDR of a byte and a message of this type: the byte, and the message by itself, which is aligned anew.
    Raises Misfit."""
    if cdr[:_HEADER_BYTES] != HEADER:
        raise Misfit
    copy = _Copy(cdr, from_unity=False, to_unity=False, strict=False, most=None)
    (byte,) = copy.pass_over(1)
    _structure(message)(copy)
    return byte, bytes(copy.out)


class _Copy:
    """Reads one form and writes the other. ``strict``: padding is zero, and nothing but padding follows the end.
    ``most``: parts that may be read; None: any."""

    def __init__(self, cdr: bytes, *, from_unity: bool, to_unity: bool, strict: bool, most: int | None) -> None:
        self._cdr = memoryview(cdr)
        self._at = _HEADER_BYTES
        self._from_unity = from_unity
        self._to_unity = to_unity
        self._strict = strict
        self._most = most
        self._parts = 0
        self.out = bytearray(HEADER)

    def end(self) -> None:
        """Look at what is left."""
        rest = len(self._cdr) - self._at
        if self._strict and (rest and (self._from_unity or rest >= _LARGE or any(self._cdr[self._at :]))):
            raise Misfit

    def spend(self, parts: int) -> None:
        """So many parts will be read. Once per sequence, so that it costs what is sent next to nothing."""
        self._parts += parts
        if self._most is not None and self._parts > self._most:
            raise TooManyParts(f"it has more than {self._most} parts")

    def values(self, size: int, count: int = 1) -> None:
        """So many numbers of this size, one at least."""
        self._align_in(size)
        self._align_out(size)
        self.out += self._take(size * count)

    def sequence_of_values(self, size: int, each: int = 0) -> None:
        """A length, and so many numbers. ``each``: so many of them count as a part."""
        if count := self.length():
            if each:
                self.spend(count // each)
            self.values(size, count)
            return
        if self._from_unity:
            self._align_in(size)
        if self._to_unity:
            self._align_out(size)

    def length(self) -> int:
        """How many items follow. None takes less than a byte, but for those of `nothing`."""
        count = self._length_in()
        if count > max(len(self._cdr), _MAX_NOTHINGS):
            raise Misfit
        self._length_out(count)
        return count

    def text(self) -> None:
        """A string, with the zero at its end."""
        text = self._text_in()
        self._length_out(len(text) + 1)
        self.out += text
        self.out.append(0)

    def wide_text(self) -> None:
        """A wstring."""
        if self._from_unity:
            utf8 = bytes(self._text_in())
            self.spend(len(utf8) // _LETTERS)
            text = utf8.decode("utf-8", "replace")
        else:
            units = self._take(_U32.size * self._length_in())
            self.spend(len(units) // _U32.size // _LETTERS)
            text = bytes(b for at in range(0, len(units), _U32.size) for b in units[at : at + 2]).decode(
                "utf-16-le", "replace"
            )
        if self._to_unity:
            utf8 = text.encode("utf-8")
            self._length_out(len(utf8) + 1)
            self.out += utf8
            self.out.append(0)
        else:
            utf16 = text.encode("utf-16-le")
            self._length_out(len(utf16) // 2)
            for at in range(0, len(utf16), 2):
                self.out += utf16[at : at + 2] + b"\0\0"

    def nothing(self) -> None:
        """A structure without fields."""
        if not self._from_unity and self._take(1)[0] and self._strict:
            raise Misfit
        if not self._to_unity:
            self.out.append(0)

    def _text_in(self) -> memoryview:
        text = self._take(self._length_in())
        if text and not text[-1]:
            return text[:-1]
        if self._from_unity:
            raise Misfit
        return text  # ROS reads one without its zero, too

    def _length_in(self) -> int:
        self._align_in(_U32.size)
        return int(_U32.unpack(self._take(_U32.size))[0])

    def _length_out(self, count: int) -> None:
        self._align_out(_U32.size)
        self.out += _U32.pack(count)

    def _align_in(self, size: int) -> None:
        padding = self._take(-(self._at - _HEADER_BYTES) % size)
        if self._strict and any(padding):
            raise Misfit

    def _align_out(self, size: int) -> None:
        self.out += bytes(-(len(self.out) - _HEADER_BYTES) % size)

    def pass_over(self, count: int) -> memoryview:
        """So many bytes that are not written."""
        return self._take(count)

    def _take(self, count: int) -> memoryview:
        begin, self._at = self._at, self._at + count
        if self._at > len(self._cdr):
            raise Misfit
        return self._cdr[begin : self._at]


# -- from a type to what copies it -----------------------------------------------------------------------------------


def _differs(shape: Shape) -> bool:
    if isinstance(shape, Structure):
        return not shape.fields or any(map(_differs, shape.fields))
    if isinstance(shape, Sequence) and isinstance(shape.item, Number):
        return shape.item.size >= _LARGE
    if isinstance(shape, Sequence | Array):
        return _differs(shape.item)
    return isinstance(shape, Text) and shape.wide


def _structure(message: Structure) -> _Part:
    parts = [_part(field) for field in message.fields]
    if not parts:
        return _Copy.nothing

    def copy_all(copy: _Copy) -> None:
        for part in parts:
            part(copy)

    return copy_all


def _part(shape: Shape) -> _Part:
    if isinstance(shape, Number):
        size = shape.size
        return lambda copy: copy.values(size)
    if isinstance(shape, Structure):
        return _structure(shape)
    if isinstance(shape, Array):
        return _array(shape.item, shape.count)
    if isinstance(shape, Sequence):
        return _sequence(shape.item)
    return _Copy.wide_text if shape.wide else _Copy.text


def _array(item: Shape, count: int) -> _Part:
    if isinstance(item, Number):
        size = item.size
        return lambda copy: copy.values(size, count)
    part = _part(item)

    def copy_items(copy: _Copy) -> None:
        for _ in range(count):
            part(copy)

    return copy_items


def _sequence(item: Shape) -> _Part:
    if isinstance(item, Number):
        size, each = item.size, _OBJECTS * item.boxed
        return lambda copy: copy.sequence_of_values(size, each)
    part, parts = _part(item), _parts_of(item)

    def copy_items(copy: _Copy) -> None:
        count = copy.length()
        copy.spend(count * parts)
        for _ in range(count):
            part(copy)

    return copy_items


def _may_have_many(shape: Shape) -> bool:
    if isinstance(shape, Sequence):
        return not isinstance(shape.item, Number) or shape.item.boxed
    if isinstance(shape, Array):
        return _may_have_many(shape.item)
    if isinstance(shape, Structure):
        return any(map(_may_have_many, shape.fields))
    return isinstance(shape, Text) and shape.wide


def _parts_of(shape: Shape) -> int:
    """What one item of a sequence has at least."""
    if isinstance(shape, Structure):
        return 1 + sum(map(_parts_of, shape.fields))
    if isinstance(shape, Array) and not isinstance(shape.item, Number):
        return shape.count * _parts_of(shape.item)
    return 1
