"""Frames of any layout, streams cut in any way, and what a decoder makes of them."""

from __future__ import annotations

from hypothesis import strategies as st

from macs_zenoh.errors import WireError
from macs_zenoh.protocol.decoders import FrameDecoder
from macs_zenoh.protocol.wire import MACS, Frame, Header, Layout, encode_frame, encode_message


def stream(decoder: FrameDecoder, pieces: list[bytes]) -> list[bytes]:
    """The frames that a decoder cuts from a stream that comes in these pieces."""
    cut = [frame for piece in pieces for frame in decoder.feed(piece)]
    assert not [error for error in cut if isinstance(error, WireError)]
    return [bytes(frame.data) for frame in cut]


def bytes_of(one: Frame | WireError) -> bytes | None:
    """What a decoder found; None for an error: of several that are wrong, pieces may show another first."""
    return bytes(one.data) if isinstance(one, Frame) else None


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    """Any number of slots; that of MACS often."""
    return draw(st.just(MACS) | st.builds(Layout, st.integers(1, 255), st.integers(1, 255)))


@st.composite
def frames(draw: st.DrawFn, layout: Layout) -> tuple[bytes, Header, bytes, bytes, bytes]:
    """A frame of a layout: its bytes and its parts. Slots may be empty anywhere."""
    agent_type = draw(st.integers(0, 255))
    ids = draw(st.lists(st.integers(0, 0xFFFF), max_size=layout.id_slots))
    groups = draw(st.lists(st.integers(0, 255), max_size=layout.group_slots))
    management, metadata, body = draw(st.tuples(*[st.binary(max_size=60)] * 3))
    message = encode_message(metadata, body)
    data = encode_frame(agent_type, ids, groups, management=management, message=message, layout=layout)
    header = Header(agent_type, tuple(filter(None, ids)), tuple(filter(None, groups)), len(management), len(message))
    return data, header, management, metadata, body


@st.composite
def cuts(draw: st.DrawFn, data: bytes) -> list[bytes]:
    """``data`` in pieces, some of them empty."""
    at = sorted(draw(st.lists(st.integers(0, len(data)), max_size=12)))
    return [data[start:end] for start, end in zip([0, *at], [*at, len(data)], strict=True)]
