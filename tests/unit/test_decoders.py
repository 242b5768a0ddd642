"""Streams of bytes: cut into the same frames and messages however they come, within bounds."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from macs_zenoh.errors import FrameTooLarge, TooLong, WireError
from macs_zenoh.protocol.decoders import FrameDecoder, MessageDecoder
from macs_zenoh.protocol.limits import CONFIGURATION_BYTES, METADATA_BYTES
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message, parse_frame
from tests.support.recordings import one_by_one
from tests.support.thorough import examples
from tests.support.wire_values import bytes_of, cuts, frames, layouts, stream


def peak_bytes(work: Callable[[], object]) -> int:
    """The most memory that ``work`` held at once beyond what was held before."""
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        work()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


# -- any pieces ------------------------------------------------------------------------------------------------------


@given(st.data())
def test_fragmentation_does_not_matter(data: st.DataObject) -> None:
    """A stream of frames gives these frames in order, however it is cut and wherever small frames are received."""
    layout = data.draw(layouts())
    sent = [raw for raw, *_ in data.draw(st.lists(frames(layout), max_size=6))]
    rest = data.draw(st.binary(max_size=layout.header_bytes - 1))
    scratch = bytearray(data.draw(st.integers(1, 100)))
    decoder = FrameDecoder(layout=layout, scratch=scratch)
    assert stream(decoder, data.draw(cuts(b"".join(sent) + rest))) == sent
    assert decoder.error is None


@given(st.data())
def test_messages_may_be_fragmented(data: st.DataObject) -> None:
    """A stream of messages gives these messages in order, however it is cut."""
    sent = data.draw(st.lists(st.builds(encode_message, st.binary(max_size=60), st.binary(max_size=60)), max_size=6))
    decoder = MessageDecoder()
    pieces = data.draw(cuts(b"".join(sent) + data.draw(st.binary(max_size=3))))
    assert [message for piece in pieces for message in decoder.feed(piece)] == sent


@given(st.data())
def test_any_bytes_give_frames_or_the_error(data: st.DataObject) -> None:
    """Any bytes at all are cut into frames, or errors in the place of those whose sizes do not add up, until a
    declared size is above the limit; into the same in one piece and in many."""
    limit = data.draw(st.integers(0, 1 << 20))
    sizes = st.builds(struct.pack, st.just("<II"), st.integers(0, 70), st.integers(0, 70) | st.integers(0, 0xFFFFFFFF))
    header = st.builds(bytes.__add__, st.binary(min_size=31, max_size=31), sizes)
    raw = b"".join(data.draw(st.lists(header | st.binary(max_size=150), max_size=8)))
    whole, piecewise = FrameDecoder(limit), FrameDecoder(limit)
    found = list(map(bytes_of, whole.feed(raw)))
    again = [bytes_of(one) for piece in data.draw(cuts(raw)) for one in piecewise.feed(piece)]
    assert again == found
    assert (whole.error is None) == (piecewise.error is None)
    rest = raw
    for one in found:
        size = 39 + sum(struct.unpack_from("<II", rest, 31))
        if one is not None:
            assert one == rest[:size]
            assert parse_frame(one).data == one
        else:
            with pytest.raises(WireError):
                parse_frame(rest[:size])
        rest = rest[size:]
    if whole.error is None:
        assert len(rest) < 39 or 39 + sum(struct.unpack_from("<II", rest, 31)) > len(rest)
    else:
        assert 39 + sum(struct.unpack_from("<II", rest, 31)) == whole.error.size > limit


# -- limits ----------------------------------------------------------------------------------------------------------


def test_the_limit_is_the_largest_frame_that_passes() -> None:
    """A frame of exactly the limit passes, whole and in pieces; one byte more is an error with both numbers."""
    frame = encode_frame(1, [2], message=encode_message(b"{}", bytes(1000)))
    for pieces in ([frame], one_by_one(frame)):
        assert stream(FrameDecoder(len(frame)), pieces) == [frame]
        decoder = FrameDecoder(len(frame) - 1)
        assert stream(decoder, pieces) == []
        assert decoder.error is not None
        assert (decoder.error.size, decoder.error.limit) == (len(frame), len(frame) - 1)


def test_the_limit_counts_management_data_and_message_together() -> None:
    """Sizes that pass one by one and not in sum are refused, without wrapping at 32 bits."""
    decoder = FrameDecoder()
    decoder.feed(MACS.pack(0, (), (), 0xFFFFFFFF, 0xFFFFFFFF))
    assert decoder.error is not None
    assert decoder.error.size == 39 + 2 * 0xFFFFFFFF


def test_what_came_before_a_frame_too_large_counts_and_nothing_after_it() -> None:
    """Frames before the one above the limit are returned; it and all that follows are not, for good."""
    good, bad = encode_frame(1, [2]), encode_frame(1, message=encode_message(b"", bytes(200)))
    decoder = FrameDecoder(100)
    assert stream(decoder, [good + good + bad + good]) == [good, good]
    error = decoder.error
    assert error is not None
    assert stream(decoder, [good, bad]) == []
    assert decoder.error is error


def test_an_error_of_one_decoder_is_no_other_decoders_error() -> None:
    """Two decoders that share a scratch buffer do not share a broken stream."""
    scratch = bytearray(64)
    broken, healthy = FrameDecoder(50, scratch=scratch), FrameDecoder(50, scratch=scratch)
    frame = encode_frame(1, [2])
    broken.feed(MACS.pack(0, (), (), 0, 1 << 20))
    assert stream(healthy, one_by_one(frame)) == [frame]
    assert broken.error is not None


def test_a_declared_size_costs_nothing() -> None:
    """A header that declares 4 GiB, or just the limit, reserves no memory for bytes that have not come."""
    for size, limit in ((0xFFFFFFF0, 32 << 20), (31 << 20, 32 << 20), (0xFFFFFFF0, 1 << 40)):
        decoder = FrameDecoder(limit)
        header = MACS.pack(0, (), (), 0, size)
        assert peak_bytes(lambda: decoder.feed(header)) < 200_000  # noqa: B023 - called at once
        assert (decoder.error is not None) == (size + 39 > limit)
    messages = MessageDecoder()
    with pytest.raises(FrameTooLarge):
        messages.feed(struct.pack("<I", 0xFFFFFFFF))
    assert peak_bytes(lambda: MessageDecoder().feed(struct.pack("<I", 31 << 20))) < 200_000


def test_memory_grows_with_what_has_come() -> None:
    """Half of a large frame costs a few times its bytes at the most, never the declared whole."""
    half = MACS.pack(0, (), (), 0, 30 << 20) + bytes(1 << 20)
    decoder = FrameDecoder()
    assert peak_bytes(lambda: decoder.feed(half)) < 5 << 20


def test_messages_have_a_limit_too() -> None:
    """A message of exactly the limit passes; one byte more in its metadata or its data is an error."""
    message = encode_message(b"{}", bytes(90))
    assert MessageDecoder(100).feed(message) == [message]
    for metadata, body in ((b"{} ", bytes(90)), (b"{}", bytes(91)), (bytes(93), b"")):
        with pytest.raises(FrameTooLarge) as raised:
            MessageDecoder(100).feed(encode_message(metadata, body))
        assert (raised.value.size, raised.value.limit) == (101, 100)


@pytest.mark.parametrize("piece", [1, 7, 64, 1000])
def test_a_large_message_can_be_let_go_of(piece: int) -> None:
    """What comes before and behind a message that is too large arrives, however it is cut; the large one is told."""
    small, large = encode_message(b"{}", bytes(90)), encode_message(b'{"a": 1}', bytes(500))
    stream, decoder = small + large + small + large + large + small, MessageDecoder(100, skip_large=True)
    got = [message for at in range(0, len(stream), piece) for message in decoder.feed(stream[at : at + piece])]
    assert got == [small] * 3
    assert [tuple(skipped) for skipped in decoder.skipped] == [(len(large), b'{"a": 1}')] * 3
    with pytest.raises(FrameTooLarge):  # metadata is never so large: that is no message
        decoder.feed(encode_message(bytes(93), b""))
    assert peak_bytes(lambda: MessageDecoder(100, skip_large=True).feed(small + large[:16])) < 200_000


# -- what is parsed is small ------------------------------------------------------------------------------------------


BIG = 20 << 20

GOOD = encode_frame(2, [3], message=encode_message(b"{}", b"data"))

OVERSIZED = [
    (encode_frame(management=b"x" * BIG), "management data"),
    (encode_frame(management=b"x" * (CONFIGURATION_BYTES + 1)), "management data"),
    (encode_frame(2, [3], message=encode_message(b"x" * BIG)), "metadata"),
    (encode_frame(2, [3], message=encode_message(b"x" * (METADATA_BYTES + 1), bytes(1 << 20))), "metadata"),
    (encode_frame(management=b"{}", message=encode_message(b"x" * 300_000)), "metadata"),
]


@pytest.mark.parametrize(("frame", "what"), OVERSIZED, ids=[f"{what} of {len(f)}" for f, what in OVERSIZED])
@pytest.mark.parametrize("piece", [1 << 30, 65_536, 10_000, 43, 39])
def test_what_is_too_long_to_parse_is_skipped_and_not_stored(frame: bytes, what: str, piece: int) -> None:
    """A frame whose management data or metadata alone is too large costs itself, told once, and hardly any memory,
    whatever the pieces in which it comes; the frames around it are whole."""
    if len(frame) > 10_000 * piece:
        piece = 3000
    decoder = FrameDecoder()
    whole = GOOD + frame + GOOD
    most = 0
    found = []
    for start in range(0, len(whole), piece):
        found += decoder.feed(memoryview(whole)[start : start + piece])
        most = max(most, decoder.partial_bytes)
    first, error, last = found
    assert (bytes(first.data), bytes(last.data)) == (GOOD, GOOD)
    assert isinstance(error, TooLong)
    assert error.what == what
    assert decoder.error is None
    assert (decoder.begun, decoder.partial_bytes) == (0, 0)
    assert most <= decoder.SPACE_BYTES


# -- receiving straight into the decoder -----------------------------------------------------------------------------


@settings(max_examples=examples(50))
@given(st.data())
def test_receiving_into_the_decoder_is_feeding_it(data: st.DataObject) -> None:
    """Filling `space` as far as bytes came and calling `advance` gives what `feed` gives, for small and big frames."""
    bodies = data.draw(st.lists(st.integers(0, 200_000) | st.integers(0, 300), max_size=4))
    sent = [encode_frame(1, [n + 1], message=encode_message(b"{}", bytes(size))) for n, size in enumerate(bodies)]
    raw = memoryview(b"".join(sent))
    decoder = FrameDecoder()
    found = []
    while raw:
        space = decoder.space()
        assert 0 < len(space) <= FrameDecoder.SPACE_BYTES
        size = min(len(space), len(raw), data.draw(st.integers(1, 100_000)))
        space[:size] = raw[:size]
        del space
        found += [bytes(frame.data) for frame in decoder.advance(size)]
        raw = raw[size:]
    assert found == sent


def test_a_frame_keeps_its_bytes() -> None:
    """Frames already returned do not change when the decoder receives on, though buffers are used again."""
    bodies = [bytes([n]) * size for n, size in enumerate((10, 100_000, 20, 70_000))]
    decoder = FrameDecoder()
    kept = [frame for body in bodies for frame in decoder.feed(encode_frame(1, message=encode_message(b"", body)))]
    decoder.feed(b"\xff" * 39)
    for frame, body in zip(kept, bodies, strict=True):
        assert bytes(frame.body) == body
