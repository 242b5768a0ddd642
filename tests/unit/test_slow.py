"""What one gateway tells another of a receiver that is full."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.slow import Note


@pytest.mark.parametrize("note", [Note(2, 256, True), Note(1, 65535, False)])
def test_a_note_comes_as_it_was_sent(note: Note) -> None:
    assert Note.decode(note.encode()) == note


@pytest.mark.parametrize("payload", [b"", b"\x02\x00\x01", Note(2, 256, True).encode() + b"\x00"])
def test_what_is_no_note(payload: bytes) -> None:
    assert Note.decode(payload) is None
