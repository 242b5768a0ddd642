"""Whether CDR is as long as its own lengths say: who reads it in ROS may end by what ends before. Pure.

Nothing is decoded. A type becomes a few steps: runs of fixed size, of which only the place where they begin matters,
and the lengths between them. So a message costs as much as it has lengths, however large it is.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from bridge.ros.shapes import HEADER_BYTES, Array, Number, Shape, Structure, Text

MOST = 1 << 18
"""Items of more than fixed size, such as texts, in one message: about 0.1 s."""
_LARGEST = 8
"""No number is aligned to more."""
_LENGTH_BYTES = 4
_WIDE_BYTES = 4
"""What a letter of a wstring takes."""

_Read = Callable[[bytes, int], tuple[int]]
_Run = tuple[int, ...]
"""How many bytes something of fixed size takes with its padding, by where it begins, modulo 8."""
_LITTLE: _Read = struct.Struct("<I").unpack_from
_BIG: _Read = struct.Struct(">I").unpack_from


class _Walk:
    """One message that is looked through."""

    __slots__ = ("cdr", "end", "items", "read")

    def __init__(self, cdr: bytes) -> None:
        self.cdr = cdr
        self.end = len(cdr)
        self.read = _LITTLE if cdr[1] else _BIG
        self.items = 0


_Step = Callable[[_Walk, int], int]
"""From a place in the message to the one behind what is there, which may be behind its end. Raises struct.error and
_TooLong."""


class _TooLong(Exception):
    """It has more items than are looked at, or than its type allows."""


class Whole:
    """One type's messages. From any thread."""

    def __init__(self, message: Structure) -> None:
        steps = _merged(_steps(message))
        self._steps = [_step(each) for each in steps]
        self._fixed = HEADER_BYTES + sum(each[HEADER_BYTES] for each in steps if isinstance(each, tuple))
        """Bytes up to the first length."""
        self._is_fixed = all(isinstance(each, tuple) for each in steps)

    def problem(self, cdr: bytes) -> str | None:
        """Why this is no message of the type; None when it may be. It begins with a CDR header."""
        if self._is_fixed:
            size = self._fixed
            return f"it is cut off, at least {size} bytes are needed" if len(cdr) < size else None
        walk, at = _Walk(cdr), HEADER_BYTES
        try:
            for step in self._steps:
                at = step(walk, at)
        except struct.error:
            return f"it is cut off: it has {len(cdr)} bytes, and what it consists of does not end there"
        except _TooLong as error:
            return str(error)
        if at > walk.end:
            return f"it is cut off: it has {len(cdr)} bytes, and what it consists of takes {at}"
        return None


def _run(take: Callable[[int], int]) -> _Run:
    """By where it begins: the position behind it, which `take` finds, less that."""
    return tuple(take(begin) - begin for begin in range(_LARGEST))


def _number(size: int) -> _Run:
    align = min(size, _LARGEST)
    return _run(lambda begin: begin + (HEADER_BYTES - begin) % align + size)


def _behind(first: _Run, second: _Run) -> _Run:
    return _run(lambda begin: begin + first[begin] + second[(begin + first[begin]) % _LARGEST])


def _times(run: _Run, count: int) -> _Run:
    """So many in a row: behind its largest number, one always ends at the same place modulo that, so that all but the
    first take the same."""

    def take(begin: int) -> int:
        if not count:
            return begin
        at = begin + run[begin]
        return at + (count - 1) * run[at % _LARGEST]

    return _run(take)


def _steps(shape: Shape) -> list[_Run | _Step]:
    """Runs, and steps between them."""
    if isinstance(shape, Number):
        return [_number(shape.size)]
    if isinstance(shape, Structure):
        fields = [step for field in shape.fields for step in _steps(field)]
        return fields or [_number(1)]  # ROS writes a byte for a structure without fields
    if isinstance(shape, Text):
        text = _wide_text if shape.wide else _text
        return [_bounded(text, shape.most, wide=shape.wide) if shape.most else text]
    inner = _merged(_steps(shape.item))
    (run,) = inner if len(inner) == 1 and isinstance(inner[0], tuple) else (None,)
    if isinstance(shape, Array):
        return [_times(run, shape.count)] if isinstance(run, tuple) else [_items(inner, shape.count)]
    items = _sequence_of_runs(run) if isinstance(run, tuple) else _items(inner, None)
    return [_few(items, shape.most) if shape.most else items]


def _merged(steps: list[_Run | _Step]) -> list[_Run | _Step]:
    merged: list[_Run | _Step] = []
    for step in steps:
        before = merged[-1] if merged else None
        if isinstance(step, tuple) and isinstance(before, tuple):
            merged[-1] = _behind(before, step)
        else:
            merged.append(step)
    return merged


def _step(step: _Run | _Step) -> _Step:
    if not isinstance(step, tuple):
        return step
    run = step
    return lambda walk, at: at + run[at & 7]


def _text(walk: _Walk, at: int) -> int:
    at = (at + 3) & -4
    return at + 4 + walk.read(walk.cdr, at)[0]


def _wide_text(walk: _Walk, at: int) -> int:
    at = (at + 3) & -4
    return at + 4 + _WIDE_BYTES * walk.read(walk.cdr, at)[0]


def _bounded(text: _Step, most: int, *, wide: bool) -> _Step:
    """A text of so many letters at most."""

    def take(walk: _Walk, at: int) -> int:
        begin = ((at + 3) & -4) + _LENGTH_BYTES
        end = text(walk, at)
        letters = (end - begin) // _WIDE_BYTES if wide else end - begin - 1
        if letters > most and not wide:  # bytes, of which a letter may have several
            letters = sum(byte & 0xC0 != 0x80 for byte in walk.cdr[begin : end - 1])
        if letters > most:
            raise _TooLong(f"a text of {letters} letters is in it, where its type has {most} at most")
        return end

    return take


def _few(items: _Step, most: int) -> _Step:
    """A sequence of so many items at most."""

    def take(walk: _Walk, at: int) -> int:
        count = walk.read(walk.cdr, (at + 3) & -4)[0]
        if count > most:
            raise _TooLong(f"a sequence of {count} items is in it, where its type has {most} at most")
        return items(walk, at)

    return take


def _sequence_of_runs(run: _Run) -> _Step:
    def take(walk: _Walk, at: int) -> int:
        at = (at + 3) & -4
        count = walk.read(walk.cdr, at)[0]
        at += 4
        if count:
            at += run[at & 7]
            at += (count - 1) * run[at & 7]
        return at

    return take


def _items(inner: list[_Run | _Step], fixed: int | None) -> _Step:
    steps = [_step(each) for each in inner]

    def take(walk: _Walk, at: int) -> int:
        count = fixed
        if count is None:
            at = (at + 3) & -4
            count = walk.read(walk.cdr, at)[0]
            at += 4
        for _ in range(count):  # ends soon when there are not so many: each has a length to be read
            walk.items += 1
            if walk.items > MOST:
                raise _TooLong(f"it has more than {MOST} parts")
            for step in steps:
                at = step(walk, at)
        return at

    return take
