"""What an agent holds of topics for subscriptions that come later."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import pytest

from macs_zenoh.held import HELD_BYTES, Held, Room, latches
from macs_zenoh.protocol.messages import encode_data
from macs_zenoh.protocol.robot_state import Offered, TopicQos


@dataclass
class Said:
    data: bytes
    received_s: float = 0.0


def test_the_newest_are_held_in_order() -> None:
    """As many as were asked for, of which a reader takes as many as it has room for."""
    held: Held[Said] = Held(Room())
    assert held.newest(3) == []
    for number in range(5):
        held.put(Said(b"%d" % number), depth=3)
    assert [each.data for each in held.newest(10)] == [b"2", b"3", b"4"]
    assert [each.data for each in held.newest(1)] == [b"4"]


def test_large_ones_are_held_as_far_as_there_is_room() -> None:
    """The newest always, others while all together are not too large."""
    held: Held[Said] = Held(Room())
    half = bytes(HELD_BYTES // 2)
    for number in range(4):
        held.put(Said(half), depth=10)
        assert len(held.newest(10)) == min(2, number + 1)
    held.put(Said(bytes(3 * HELD_BYTES)), depth=10)
    assert len(held.newest(10)) == 1
    held.put(Said(b"small"), depth=10)
    assert [each.data for each in held.newest(10)] == [b"small"]


def test_cameras_make_room_for_a_map() -> None:
    """Where all together is too much, what brings most goes, whoever came first; what is let go of makes room."""
    room = Room(100)
    cameras: list[Held[Said]] = [Held(room) for _ in range(3)]
    latched: Held[Said] = Held(room)
    for second in range(5):
        for camera in cameras:
            camera.put(Said(bytes(40), second), depth=3)
    assert room.bytes <= 100
    latched.put(Said(bytes(60), 5), depth=3)
    for second in range(6, 600):
        for camera in cameras:
            camera.put(Said(bytes(40), second), depth=3)
        assert (len(latched.newest(3)), latched.is_short, room.bytes) == (1, False, 100)
    assert sum(camera.is_short for camera in cameras) >= 2
    latched.clear()
    for camera in cameras:
        camera.clear()
    assert (room.bytes, room.holding) == (0, set())


def test_what_is_too_large_for_all_is_known_to_be_missing() -> None:
    """Until as many as are wanted have come after it."""
    held: Held[Said] = Held(Room(100))
    held.put(Said(bytes(101)), depth=2)
    assert (held.newest(2), held.is_short) == ([], True)
    held.put(Said(b"1"), depth=2)
    assert held.is_short
    held.put(Said(b"2"), depth=2)
    assert (len(held.newest(2)), held.is_short) == (2, False)


@pytest.mark.parametrize(
    ("answer", "is_latched"),
    [
        (encode_data(Offered(qos={"/map": TopicQos("reliable", "transient_local")})), True),
        (encode_data(Offered(qos={"/map": TopicQos("reliable", "volatile")})), False),
        (encode_data(Offered(qos={"/other": TopicQos("reliable", "transient_local")})), False),
        (msgspec.json.encode({"publishers": {"/map": "nav_msgs/OccupancyGrid"}}), False),
        (b"", False),
        (b"[" * 100_000, False),
        (b'{"qos":{"/map":7}}', False),
    ],
)
def test_a_robot_says_what_latches(answer: bytes, is_latched: bool) -> None:
    """What is not said, or is no answer, is not latched."""
    assert latches(answer, "/map") == is_latched
