"""What a program tells whoever pings it is read as it was written, and bad answers are errors."""

from __future__ import annotations

import pytest

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import WireError
from macs_zenoh.protocol.ping import MOST_AWAY, decode, encode, pong
from macs_zenoh.protocol.wire import encode_message


def test_it_is_read_as_it_was_written() -> None:
    """Every field and the echo come back; of agents that are away so many are named that the answer has a size."""
    away = [(2, number) for number in range(1, MOST_AWAY + 100)]
    said = pong(
        MeshSettings(lease_ms=3000),
        now_s=12.5,
        macs="1.2.3",
        zenoh="1.10.2",
        drops={"no_route": 3},
        now={"waiting_for_id": 1},
        away=away,
        address="10.0.0.1:7000",
    )
    assert decode(encode(said, b"echo")) == (said, b"echo")
    assert (said.lease_ms, said.mode, said.away) == (3000, "client", away[:MOST_AWAY])


@pytest.mark.parametrize(
    "answer", [b"", b"\0" * 8, encode_message(b"{"), encode_message(b"[]"), encode_message(b'{"time_s": "now"}')]
)
def test_what_is_no_answer_is_an_error_of_the_peer(answer: bytes) -> None:
    """Bytes that are no answer raise a WireError, whatever is wrong with them."""
    with pytest.raises(WireError):
        decode(answer)


def test_fields_that_are_not_known_are_left_out() -> None:
    """A program of another version is understood as far as it goes."""
    said, echo = decode(encode_message(b'{"time_s": 1.5, "colour": "red"}', b"x"))
    assert (said.time_s, said.macs, echo) == (1.5, "", b"x")
