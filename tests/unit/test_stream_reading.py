"""Robots' topic data, as an agent reads it: what lists it, and nothing else."""

from __future__ import annotations

import pytest

from macs_zenoh.errors import WireError
from macs_zenoh.protocol.messages import Metadata, NodeType, StreamData, decode_data, encode_data, encode_management
from macs_zenoh.protocol.robot_state import StreamCount
from macs_zenoh.protocol.stream_reading import KNOWN, KNOWN_BYTES, StreamReader
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message

KEY = "macs/from/ros/7/nd__pose"
ME = (2, 5)


def frame(
    listed: dict[str, list[int]],
    data: bytes = b"\0\1\0\0x",
    name: str = "nd__pose",
    kind: int = 1,
    manager: str = StreamData.manager,
) -> bytes:
    metadata = Metadata(
        1, 7, message_manager=manager, node_type=kind, node_name=name, data_exchange_type="std_msgs/String"
    )
    management = encode_management(StreamData(listed))
    return encode_frame(1, management=management, message=encode_message(metadata.encode(), data))


@pytest.fixture
def bad() -> list[WireError]:
    return []


@pytest.fixture
def reader(bad: list[WireError]) -> StreamReader:
    return StreamReader(MACS, lambda key, error: bad.append(error))


def test_only_what_lists_me_is_mine(reader: StreamReader, bad: list[WireError]) -> None:
    """Data for others, and for another type with my id, is none of mine; several frames in a sample are several."""
    mine, theirs = frame({"2": [4, 5]}), frame({"2": [6], "1": [5]})
    assert reader.read(KEY, "nd__pose", mine, ME) == [b"\0\1\0\0x"]
    assert reader.read(KEY, "nd__pose", theirs, ME) == []
    assert reader.read(KEY, "nd__pose", theirs, (1, 5)) == [b"\0\1\0\0x"]
    assert reader.read(KEY, "nd__pose", mine + theirs + frame({"2": [5]}, b"second"), ME) == [b"\0\1\0\0x", b"second"]
    assert bad == []


def test_a_count_is_no_data() -> None:
    """How much a robot has put is told to who asked, behind the data; to others it says nothing."""
    told: list[tuple[str, bytes]] = []
    reader = StreamReader(MACS, lambda key, error: None, lambda key, data: told.append((key, data)))
    count = frame({"2": [5]}, encode_data(StreamCount(3, 4)), manager=StreamCount.manager)
    assert reader.read(KEY, "nd__pose", frame({"2": [5]}) + count, ME) == [b"\0\1\0\0x"]
    assert reader.read(KEY, "nd__pose", count, (2, 6)) == []
    assert [(key, decode_data(StreamCount, data)) for key, data in told] == [(KEY, StreamCount(3, 4))]


def test_a_new_id_is_not_the_old_one(reader: StreamReader) -> None:
    """What was read for one id is not remembered for another."""
    sample = frame({"2": [5]})
    assert reader.read(KEY, "nd__pose", sample, ME) == [b"\0\1\0\0x"]
    assert reader.read(KEY, "nd__pose", sample, (2, 6)) == []


@pytest.mark.parametrize(
    "sample",
    [
        b"",
        b"x" * 100,
        frame({"2": [5]}, name="nd__other"),
        frame({"2": [5]}, kind=NodeType.PUBLISHER),
        frame({"2": [5]})[:-1],
        encode_frame(1, management=b"{", message=encode_message(Metadata(1, 7, 0, "", 1, "nd__pose").encode())),
        encode_frame(1, management=b"{}", message=encode_message(b"no json")),
    ],
)
def test_what_is_none_is_told_and_costs_that_sample(reader: StreamReader, bad: list[WireError], sample: bytes) -> None:
    """A sample that is no topic data of this node is told, and the next one is read."""
    assert reader.read(KEY, "nd__pose", sample, ME) == []
    assert len(bad) == 1
    assert reader.read(KEY, "nd__pose", frame({"2": [5]}), ME) == [b"\0\1\0\0x"]


def test_what_is_remembered_is_bounded(reader: StreamReader) -> None:
    """However many beginnings a robot thinks of, so many are kept, and none that is long."""
    for other in range(KNOWN + 10):
        reader.read(KEY, "nd__pose", frame({"2": [5], "1": [other]}), ME)
    assert len(reader._known) <= KNOWN
    before = len(reader._known)
    long = frame({"2": [5, *range(100, 100 + KNOWN_BYTES // 3)]})
    assert reader.read(KEY, "nd__pose", long, ME) == [b"\0\1\0\0x"]
    assert len(reader._known) == before
