"""Bytes in pieces, to be written one after the other. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

_Piece = TypeVar("_Piece", bytes, "bytes | bytearray | memoryview")


def small_joined(pieces: Sequence[_Piece], large_bytes: int) -> list[_Piece]:
    """The same in fewer pieces: those of less than ``large_bytes`` that follow each other are one, large ones are not
    copied."""
    joined: list[_Piece] = []
    small: list[_Piece] = []
    for piece in pieces:
        if len(piece) < large_bytes:
            small.append(piece)
            continue
        if small:
            joined.append(b"".join(small))
            small = []
        joined.append(piece)
    if small:
        joined.append(b"".join(small))
    return joined
