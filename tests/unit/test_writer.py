"""What a connection writes at once."""

from __future__ import annotations

import pytest

from bridge.gateway.writer import RECORD_BYTES, joined

SMALL, LARGE = b"x" * 100, b"y" * RECORD_BYTES


@pytest.mark.parametrize(
    ("chunks", "pieces"),
    [
        ([SMALL, SMALL], [2 * SMALL]),
        ([LARGE, LARGE], [LARGE, LARGE]),
        ([SMALL, LARGE, SMALL, SMALL, LARGE], [SMALL, LARGE, 2 * SMALL, LARGE]),
        ([LARGE, SMALL], [LARGE, SMALL]),
        ([], []),
    ],
)
def test_small_pieces_are_encrypted_together(chunks: list[bytes], pieces: list[bytes]) -> None:
    """A record for each small message would cost more than the message; large ones are not copied."""
    assert joined(chunks) == pieces  # type: ignore[arg-type]
    large = [piece for piece in joined(chunks) if piece == LARGE]  # type: ignore[arg-type]
    assert all(piece is LARGE for piece in large)
