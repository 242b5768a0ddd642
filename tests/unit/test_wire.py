"""Header, frame and message: bytes to values and back, in any pieces, whatever the bytes are."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from contextlib import nullcontext, suppress
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from macs_zenoh.errors import BadSizes, FrameTooLarge, OutOfRange, TooLong, TooManyDestinations, WireError
from macs_zenoh.protocol.decoders import FrameDecoder, MessageDecoder
from macs_zenoh.protocol.limits import CONFIGURATION_BYTES, MANAGEMENT_BYTES, METADATA_BYTES, SAMPLE_BYTES
from macs_zenoh.protocol.wire import (
    COPY_BYTES,
    EMPTY_MESSAGE,
    MACS,
    PROBE,
    Frame,
    Header,
    Layout,
    Run,
    encode_frame,
    encode_message,
    parse_frame,
    parse_frames,
    parse_runs,
    split_message,
)
from tests.support.recordings import cut_around, one_by_one


class Vector(NamedTuple):
    """A frame written down by hand, and what is in it."""

    name: str
    hex: str
    header: Header
    management: bytes
    metadata: bytes
    body: bytes


VECTORS = [
    Vector(
        "all zero but the size of an empty message",
        "00" * 35 + "08000000" + "00" * 8,
        Header(0, (), (), 0, 8),
        b"",
        b"",
        b"",
    ),
    Vector(
        "every slot taken, every number at its largest",
        "ff" + "ffff" * 10 + "ff" * 10 + "02000000" + "0a000000" + "7b7d" + "02000000" + "7b7d" + "00000000",
        Header(255, (0xFFFF,) * 10, (255,) * 10, 2, 10),
        b"{}",
        b"{}",
        b"",
    ),
    Vector(
        "little-endian: id 258 is 02 01",
        "01" + "0201" + "00" * 18 + "03" + "00" * 9 + "00000000" + "0c000000" + "02000000" + "7b7d02000000" + "6869",
        Header(1, (258,), (3,), 0, 12),
        b"",
        b"{}",
        b"hi",
    ),
    Vector(
        "management data and no message but an empty one",
        "00" * 31 + "25000000" + "08000000" + b'{"messageManager":"HeartbeatHandler"}'.hex() + "00" * 8,
        Header(0, (), (), 37, 8),
        b'{"messageManager":"HeartbeatHandler"}',
        b"",
        b"",
    ),
    Vector(
        "data without metadata",
        "02" + "0500" + "00" * 18 + "07" + "00" * 9 + "00000000" + "0b000000" + "00000000" + "03000000" + "000102",
        Header(2, (5,), (7,), 0, 11),
        b"",
        b"",
        b"\0\1\2",
    ),
]
ENDS_OF_PARTS = [1, 21, 31, 35, 39]

LIES = [
    ("no room for the sizes", bytes(7), "message", 8, 7),
    ("nothing at all", b"", "message", 8, 0),
    ("metadata longer than the message", struct.pack("<II", 1, 0), "metadata", 1, 0),
    ("metadata of 4 GiB", struct.pack("<II", 0xFFFFFFFF, 0), "metadata", 0xFFFFFFFF, 0),
    ("metadata that would be negative", struct.pack("<II", 0xFFFFFFFC, 0), "metadata", 0xFFFFFFFC, 0),
    ("metadata with its highest bit set", struct.pack("<I2sI", 0x80000002, b"{}", 0), "metadata", 0x80000002, 2),
    ("data longer than the message", struct.pack("<I2sI", 2, b"{}", 1), "data", 1, 0),
    ("data shorter than the message", struct.pack("<I2sI3s", 2, b"{}", 1, b"abc"), "data", 1, 3),
    ("data of 4 GiB", struct.pack("<I2sI", 2, b"{}", 0xFFFFFFFF), "data", 0xFFFFFFFF, 0),
    ("bytes behind an empty message", bytes(9), "data", 0, 1),
]
"""Messages whose inner sizes do not add up: name, bytes, and what the error tells."""


def by_name(row: object) -> str:
    """Test ids that tell the row."""
    return str(getattr(row, "name", row))


def shares(frame: Frame | WireError) -> tuple[Header, bytes, bytes, bytes]:
    """The parts of a frame."""
    assert isinstance(frame, Frame)
    return frame.header, frame.management, frame.metadata, bytes(frame.body)


def stream(decoder: FrameDecoder, pieces: list[bytes]) -> list[bytes]:
    """The frames that a decoder cuts from a stream that comes in these pieces."""
    cut = [frame for piece in pieces for frame in decoder.feed(piece)]
    assert not [error for error in cut if isinstance(error, WireError)]
    return [bytes(frame.data) for frame in cut]


def bytes_of(one: Frame | WireError) -> bytes | None:
    """What a decoder found; None for an error: of several that are wrong, pieces may show another first."""
    return bytes(one.data) if isinstance(one, Frame) else None


def peak_bytes(work: Callable[[], object]) -> int:
    """The most memory that ``work`` held at once beyond what was held before."""
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        work()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


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


# -- vectors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("vector", VECTORS, ids=by_name)
def test_a_vector_is_encoded(vector: Vector) -> None:
    """The values written down make the bytes written down."""
    message = encode_message(vector.metadata, vector.body)
    header = vector.header
    data = encode_frame(header.agent_type, header.ids, header.groups, management=vector.management, message=message)
    assert data.hex() == vector.hex


@pytest.mark.parametrize("vector", VECTORS, ids=by_name)
def test_a_vector_is_decoded_in_any_pieces(vector: Vector) -> None:
    """The bytes written down give the values, whole, byte by byte, cut around every boundary, and with more behind."""
    data = bytes.fromhex(vector.hex)
    expected = vector[2:]
    end_of_metadata = 39 + len(vector.management) + 4 + len(vector.metadata)
    ends = [*ENDS_OF_PARTS, 39 + len(vector.management), end_of_metadata, end_of_metadata + 4]
    assert shares(parse_frame(data)) == expected
    for pieces in ([data], one_by_one(data), *cut_around(data, ends), [data + b"\0"], [data + data[:-1]]):
        decoder = FrameDecoder()
        assert [shares(frame) for piece in pieces for frame in decoder.feed(piece)] == [expected]


@pytest.mark.parametrize(("name", "message", "what", "declared", "available"), LIES, ids=by_name)
def test_a_message_that_lies_about_its_sizes_is_found_out(
    name: str, message: bytes, what: str, declared: int, available: int
) -> None:
    """Sizes inside a message that do not add up are told, in a message and in the frame around it; the frame's end
    is known all the same, so the next frame is found."""
    for attempt in (lambda: split_message(message), lambda: parse_frame(encode_frame(1, message=message))):
        with pytest.raises(BadSizes) as raised:
            attempt()
        assert (raised.value.what, raised.value.declared, raised.value.available) == (what, declared, available)
    lying, good = FrameDecoder().feed(encode_frame(1, message=message) + encode_frame(2))
    assert isinstance(lying, BadSizes)
    assert (lying.what, lying.declared, lying.available) == (what, declared, available)
    assert good.header.agent_type == 2


def test_empty_slots_may_be_anywhere() -> None:
    """Empty slots between the others are left out; what is in the others keeps its order and its duplicates."""
    raw = struct.pack("<B10H10BII", 1, 0, 9, 0, 0, 4, 9, 0, 0, 0, 7, 0, 0, 5, 0, 0, 0, 5, 0, 0, 3, 0, 8) + bytes(8)
    assert parse_frame(raw).header == Header(1, (9, 4, 9, 7), (5, 5, 3), 0, 8)


# -- any values ------------------------------------------------------------------------------------------------------


@given(st.data())
def test_a_header_comes_back(data: st.DataObject) -> None:
    """What is packed into a header of any layout is unpacked from it, wherever in a buffer it starts."""
    layout = data.draw(layouts())
    ids = data.draw(st.lists(st.integers(1, 0xFFFF), max_size=layout.id_slots))
    groups = data.draw(st.lists(st.integers(1, 255), max_size=layout.group_slots))
    sizes = data.draw(st.tuples(st.integers(0, 0xFFFFFFFF), st.integers(0, 0xFFFFFFFF)))
    agent_type = data.draw(st.integers(0, 255))
    before, after = data.draw(st.binary(max_size=50)), data.draw(st.binary(max_size=50))
    packed = layout.pack(agent_type, ids, groups, *sizes)
    assert len(packed) == layout.header_bytes == 9 + 2 * layout.id_slots + layout.group_slots
    assert layout.unpack(before + packed + after, len(before)) == (agent_type, tuple(ids), tuple(groups), *sizes)


@given(st.data())
def test_a_frame_comes_back(data: st.DataObject) -> None:
    """What is encoded into a frame of any layout is decoded from it; its destination starts its header."""
    layout = data.draw(layouts())
    raw, *parts = data.draw(frames(layout))
    frame = parse_frame(raw, layout)
    assert shares(frame) == tuple(parts)
    assert frame.destination == raw[: layout.header_bytes - 8]
    assert frame.has_management == bool(parts[1])
    assert bytes(frame.message) == raw[layout.header_bytes + len(parts[1]) :]


@given(st.binary(max_size=300), st.binary(max_size=300))
def test_a_message_comes_back(metadata: bytes, body: bytes) -> None:
    """What is encoded into a message is split out of it; the data is not copied."""
    message = encode_message(metadata, body)
    assert len(message) == 8 + len(metadata) + len(body)
    found_metadata, found_body = split_message(message)
    assert (found_metadata, bytes(found_body)) == (metadata, body)
    assert found_body.obj is message


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
            shares(parse_frame(one))
        else:
            with pytest.raises(WireError):
                parse_frame(rest[:size])
        rest = rest[size:]
    if whole.error is None:
        assert len(rest) < 39 or 39 + sum(struct.unpack_from("<II", rest, 31)) > len(rest)
    else:
        assert 39 + sum(struct.unpack_from("<II", rest, 31)) == whole.error.size > limit


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_an_error(raw: bytes) -> None:
    """Any bytes either split into parts that make them again, or raise BadSizes; a stream of them, FrameTooLarge."""
    with suppress(BadSizes):
        assert encode_message(*split_message(raw)) == raw
    with suppress(FrameTooLarge):
        assert raw.startswith(b"".join(MessageDecoder(1 << 16).feed(raw)))


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


def test_whole_frames_are_judged_like_those_in_pieces() -> None:
    """Metadata of exactly the limit passes, a byte more is refused; in a sample management data as well."""
    for size, passes in ((METADATA_BYTES, True), (METADATA_BYTES + 1, False)):
        frame = encode_frame(2, [3], message=encode_message(b"x" * size, b"data"))
        for read in (parse_frame, parse_frames, parse_runs):
            with nullcontext() if passes else pytest.raises(TooLong):
                read(frame)
        with nullcontext() if passes else pytest.raises(TooLong):
            split_message(frame[39:])
    for size, passes in ((MANAGEMENT_BYTES, True), (MANAGEMENT_BYTES + 1, False)):
        frame = encode_frame(management=b"x" * size, message=encode_message(b"{}", b"data"))
        for read in (parse_frame, parse_frames, parse_runs):
            with nullcontext() if passes else pytest.raises(TooLong):
                read(frame)


# -- receiving straight into the decoder -----------------------------------------------------------------------------


@settings(max_examples=50)
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


def test_the_message_of_a_big_frame_is_not_copied() -> None:
    """What goes to an agent's socket is a view where a copy would be dear, and bytes where it is cheap."""
    big = parse_frame(encode_frame(1, message=encode_message(b"{}", bytes(COPY_BYTES))))
    assert isinstance(big.message, memoryview)
    assert big.message.obj is big.data
    assert isinstance(parse_frame(encode_frame(1)).message, bytes)


# -- our caller's mistakes -------------------------------------------------------------------------------------------


def test_more_destinations_than_slots_are_refused() -> None:
    """One id or group too many raises TooManyDestinations, which tells how many there were and may be."""
    for ids, groups, kind in (([1] * 11, [], "ids"), ([], [1] * 11, "groups")):
        with pytest.raises(TooManyDestinations) as raised:
            MACS.pack(1, ids, groups)
        assert (raised.value.kind, raised.value.count, raised.value.limit) == (kind, 11, 10)
    assert MACS.unpack(MACS.pack(1, [1] * 10, [1] * 10)).ids == (1,) * 10


@pytest.mark.parametrize(
    ("agent_type", "ids", "groups", "management_bytes", "message_bytes"),
    [
        (256, [], [], 0, 0),
        (-1, [], [], 0, 0),
        (1, [65536], [], 0, 0),
        (1, [-1], [], 0, 0),
        (1, [], [256], 0, 0),
        (1, [], [-1], 0, 0),
        (1, [], [], 1 << 32, 0),
        (1, [], [], 0, 1 << 32),
        (1, [], [], 0, -1),
    ],
)
def test_numbers_that_do_not_fit_are_refused(
    agent_type: int, ids: list[int], groups: list[int], management_bytes: int, message_bytes: int
) -> None:
    """A number that its field cannot carry raises OutOfRange with the range that it can."""
    with pytest.raises(OutOfRange) as raised:
        MACS.pack(agent_type, ids, groups, management_bytes, message_bytes)
    assert not raised.value.low <= raised.value.value <= raised.value.high


@pytest.mark.parametrize("slots", [(0, 10), (10, 0), (256, 10), (10, 256), (-1, 10)])
def test_a_layout_has_1_to_255_slots(slots: tuple[int, int]) -> None:
    """A layout with no slots, or with more than 255, raises OutOfRange."""
    with pytest.raises(OutOfRange):
        Layout(*slots)


def test_the_default_layout_is_that_of_macs() -> None:
    """The default header has 39 bytes, and an empty message 8 zeros."""
    assert Layout(10, 10) == MACS
    assert MACS.header_bytes == struct.calcsize("<B10H10BII") == 39
    assert EMPTY_MESSAGE == encode_message(b"") == bytes(8)


def test_a_header_that_ends_early_is_told() -> None:
    """Unpacking needs a whole header from the offset on."""
    with pytest.raises(BadSizes) as raised:
        MACS.unpack(bytes(45), at=7)
    assert (raised.value.declared, raised.value.available) == (39, 38)
    with pytest.raises(BadSizes):
        MACS.unpack(bytes(39), at=100)


def test_a_run_is_its_frames() -> None:
    """Frames that begin alike come as one run with everything in it; what differs in a size or a byte does not."""
    alike = [encode_frame(2, (5,), message=encode_message(b'{"a":1}', bytes([number] * 9))) for number in range(5)]
    other = encode_frame(2, (6,), message=encode_message(b'{"a":1}', bytes(9)))
    longer = encode_frame(2, (5,), message=encode_message(b'{"a":1}', bytes(10)))
    stream = b"".join([*alike, other, longer, *alike[:2]])
    frames = FrameDecoder(runs=True).feed(stream)
    assert [frame.count for frame in frames] == [5, 1, 1, 2]
    assert [bytes(frame.data) for run in frames for frame in run.each()] == [*alike, other, longer, *alike[:2]]
    assert [bytes(message) for message in frames[0].messages] == [frame[39:] for frame in alike]
    assert list(map(type, frames)) == [Run, Frame, Frame, Run]
    assert [f.count for f in parse_runs(stream)] == [5, 1, 1, 2]
    assert [bytes(f.data) for f in parse_frames(stream)] == [*alike, other, longer, *alike[:2]]
    assert b"".join(bytes(f.data) for f in parse_frames(stream)) == stream


def test_a_run_never_swallows_a_bad_frame() -> None:
    """A frame in which only the size of the data lies is not taken into a run, and is found out."""
    good = encode_frame(2, (5,), message=encode_message(b'{"a":1}', bytes(9)))
    at = 39 + 4 + 7
    bad = good[:at] + (8).to_bytes(4, "little") + good[at + 4 :]
    frames = FrameDecoder(runs=True).feed(good + bad + good)
    assert list(map(type, frames)) == [Frame, BadSizes, Frame]


def test_a_probe_carries_no_frame() -> None:
    """What `macs security check` puts is no frame and no error; what is as long as a header is judged as a frame."""
    assert parse_frames(PROBE) == []
    assert parse_frames(PROBE + b" 123") == []
    with pytest.raises(BadSizes):
        parse_frames(PROBE[:-1])
    with pytest.raises(BadSizes):
        parse_frames(PROBE.ljust(MACS.header_bytes, b"x"))


def test_several_frames_in_a_sample_are_bounded_together() -> None:
    """One frame may be as large as it likes, several only so large that they are handled in a moment."""
    small = encode_frame(2, (1,), message=encode_message(b"{}", bytes(100)))
    count = SAMPLE_BYTES // len(small)
    assert sum(frame.count for frame in parse_runs(small * count)) == count
    for data in (small * (count + 1), encode_frame(message=encode_message(b"{}", bytes(SAMPLE_BYTES))) + small):
        with pytest.raises(TooLong):
            parse_frames(data)
    assert len(parse_frames(encode_frame(message=encode_message(b"{}", bytes(2 * SAMPLE_BYTES))))) == 1
