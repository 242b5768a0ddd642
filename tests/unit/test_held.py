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


def test_all_together_hold_no_more_than_there_is_room_for() -> None:
    """What would be too much of one topic costs no other what it holds; what is let go of makes room."""
    room = Room(100)
    one: Held[Said] = Held(room)
    other: Held[Said] = Held(room)
    one.put(Said(bytes(80)), depth=3)
    other.put(Said(bytes(15)), depth=3)
    other.put(Said(bytes(10)), depth=3)
    assert (len(one.newest(3)), [len(each.data) for each in other.newest(3)]) == (1, [10])
    other.put(Said(bytes(30)), depth=3)
    assert (len(one.newest(3)), other.newest(3), room.bytes) == (1, [], 80)
    one.clear()
    assert room.bytes == 0


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
