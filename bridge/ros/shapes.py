"""What messages consist of, as far as bytes go, whoever knows their definitions: rclpy or rosbags. Pure."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Number:
    """A number of so many bytes; a boolean and a letter are numbers, too. ``boxed``: read as many, Python makes an
    object of each."""

    size: int
    boxed: bool = False


@dataclass(frozen=True)
class Text:
    """A string, or a wstring; with ``most``, of so many letters at most."""

    wide: bool = False
    most: int = 0


@dataclass(frozen=True)
class Structure:
    """A message, or one within another."""

    fields: tuple[Shape, ...]


@dataclass(frozen=True)
class Array:
    """Always so many items."""

    item: Shape
    count: int


@dataclass(frozen=True)
class Sequence:
    """Any number of items, behind their number; with ``most``, so many at most."""

    item: Shape
    most: int = 0


Shape = Number | Text | Structure | Array | Sequence

HEADER_BYTES = 4
"""The encapsulation before all CDR."""
_LENGTH_BYTES = 4


def least_cdr_bytes(message: Structure) -> int:
    """The fewest bytes that any CDR of this type can have, with its 4 byte encapsulation header.

    Padding is not counted, and text and sequences count as empty, so no valid message is shorter, whoever wrote it.
    For a type of fixed size (a Twist) it is nearly exact: a truncated command is caught without decoding.
    """
    return HEADER_BYTES + _least_bytes(message)


def _least_bytes(shape: Shape) -> int:
    if isinstance(shape, Number):
        return shape.size
    if isinstance(shape, Structure):
        return sum(map(_least_bytes, shape.fields))
    if isinstance(shape, Array):
        return shape.count * _least_bytes(shape.item)
    return _LENGTH_BYTES  # of a string or a sequence: its length, 0
