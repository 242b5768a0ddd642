"""Header, frame and message: bytes to values and back, in any pieces, whatever the bytes are."""

from __future__ import annotations

import struct
from contextlib import nullcontext, suppress
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.errors import BadSizes, FrameTooLarge, OutOfRange, TooLong, TooManyDestinations, WireError
from macs_zenoh.protocol.decoders import FrameDecoder, MessageDecoder
from macs_zenoh.protocol.limits import MANAGEMENT_BYTES, METADATA_BYTES, SAMPLE_BYTES
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
from tests.support.wire_values import frames, layouts


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


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_an_error(raw: bytes) -> None:
    """Any bytes either split into parts that make them again, or raise BadSizes; a stream of them, FrameTooLarge."""
    with suppress(BadSizes):
        assert encode_message(*split_message(raw)) == raw
    with suppress(FrameTooLarge):
        assert raw.startswith(b"".join(MessageDecoder(1 << 16).feed(raw)))


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


@given(bodies=st.lists(st.binary(min_size=3, max_size=3), min_size=1, max_size=5), said=st.binary(max_size=40))
def test_a_run_gets_other_metadata_as_its_frames_would_one_by_one(bodies: list[bytes], said: bytes) -> None:
    """Byte for byte, however many they are; and what comes out is such a run itself."""

    def run(metadata: bytes) -> bytes:
        return b"".join(encode_frame(2, (1,), (3,), message=encode_message(metadata, body)) for body in bodies)

    (frame,) = parse_runs(run(b'{"a":1}'))
    other = frame.with_metadata(said)
    assert (other.data, other.count, other.metadata) == (run(said), len(bodies), said)
    assert [bytes(single.body) for single in other.each()] == bodies
