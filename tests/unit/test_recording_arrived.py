"""What of a robot's topic has not come to a recording: what the robot counts, and what is missing of it."""

from __future__ import annotations

from bridge.recording.arrived import Arrived
from bridge.ros.counts import AGAIN_S, PutFor, telling
from bridge.ros.interface import Registrant
from macs_zenoh.protocol.messages import Metadata
from macs_zenoh.protocol.robot_state import StreamCount
from macs_zenoh.serving import Call

RECORDER, HEADSET, LATER = (2, 256), (2, 5), (2, 6)


def test_each_registrant_is_counted_for() -> None:
    """What was put before it registered, or for others alone, is none of its."""
    put = PutFor()
    put.registered(frozenset([HEADSET]))
    put.add(frozenset([HEADSET]))
    put.registered(frozenset([HEADSET, RECORDER]))
    for _ in range(3):
        put.add(frozenset([HEADSET, RECORDER]))
    put.add(frozenset([HEADSET]))
    counts = [put.to_tell(each, again=False) for each in (HEADSET, RECORDER)]
    assert [count.put for count in counts if count] == [5, 3]
    assert put.to_tell(LATER, again=True) is None


def test_nothing_is_told_twice_unless_asked() -> None:
    """A topic that stands still costs no link anything."""
    put = PutFor()
    put.registered(frozenset([RECORDER]))
    assert put.to_tell(RECORDER, again=False) is None
    put.add(frozenset([RECORDER]))
    first = put.to_tell(RECORDER, again=False)
    assert first is not None
    assert first.put == 1
    assert put.to_tell(RECORDER, again=False) is None
    assert put.to_tell(RECORDER, again=True) == first


def test_who_registers_again_is_counted_from_none() -> None:
    """And can tell by the time that it is another registration."""
    put = PutFor()
    put.registered(frozenset([RECORDER]))
    put.add(frozenset([RECORDER]))
    before = put.to_tell(RECORDER, again=True)
    put.registered(frozenset([]))
    put.registered(frozenset([RECORDER]))
    after = put.to_tell(RECORDER, again=True)
    assert before is not None
    assert after is not None
    assert (before.put, after.put) == (1, 0)
    assert before.since != after.since


def test_who_is_registered_while_a_message_is_put() -> None:
    """It was for those who were registered when it began to be put, whoever has come or left since."""
    put = PutFor()
    before = frozenset([HEADSET, LATER])
    put.registered(before)
    put.registered(frozenset([HEADSET, RECORDER]))
    put.add(before)
    counts = [put.to_tell(each, again=True) for each in (HEADSET, RECORDER, LATER)]
    assert [count and count.put for count in counts] == [1, 0, None]


def test_many_registrants_cost_a_message_nothing() -> None:
    """What goes to all is counted once for all of them."""
    put = PutFor()
    everybody = frozenset((2, number) for number in range(1, 1000))
    put.registered(everybody)
    for _ in range(3):
        put.add(everybody)
    put.add(frozenset([HEADSET]))
    assert not put._apart.keys() - {HEADSET}
    counts = [put.to_tell(each, again=True) for each in (HEADSET, LATER)]
    assert [count and count.put for count in counts] == [4, 3]


class Node:
    """Notes who is told what."""

    def __init__(self) -> None:
        self.told: list[tuple[int, bool]] = []

    def tell_count(self, registrant: Registrant, *, again: bool) -> None:
        self.told.append((registrant.id, again))


async def test_nobody_has_many_messages_put_by_asking() -> None:
    """Each is told twice a second, whoever else asks; the state is answered each time, and to any data."""
    node, time_s = Node(), [100.0]
    answer = telling([node], lambda: b"state", lambda: time_s[0])  # type: ignore[list-item]

    async def ask(sender: int, data: bytes) -> None:
        assert await answer(Call("status", "unity", sender, Metadata(), data)) == b"state"

    for data in (b"", b"x", b"{}", b'{"counts": "old"}', b'{"counts": "new"}', b'{"counts": "all"}'):
        await ask(5, data)
    await ask(6, b'{"counts": "all"}')
    time_s[0] += AGAIN_S
    await ask(5, b'{"counts": "all"}')
    assert node.told == [(5, False), (6, True), (5, True)]


def came(arrived: Arrived, messages: int) -> None:
    for _ in range(messages):
        arrived.message()


def test_what_has_not_come_is_lost() -> None:
    """Once, when it is told, and what comes later makes no loss undone or greater."""
    arrived = Arrived()
    came(arrived, 3)
    assert arrived.count(StreamCount(1, 3)) == 0
    came(arrived, 2)
    assert arrived.count(StreamCount(1, 10)) == 5
    assert arrived.count(StreamCount(1, 10)) == 0
    came(arrived, 4)
    assert arrived.count(StreamCount(1, 14)) == 0
    assert arrived.lost == 5


def test_what_has_come_before_it_is_counted_is_no_gain() -> None:
    """A robot counts what it has put behind it: a message may come before its count."""
    arrived = Arrived()
    came(arrived, 4)
    assert arrived.count(StreamCount(1, 3)) == 0
    assert arrived.count(StreamCount(1, 5)) == 1


def test_a_robot_that_was_started_again_has_lost_nothing_by_that() -> None:
    """It counts from none; what is lost after its first word is known again."""
    arrived = Arrived()
    came(arrived, 90)
    assert arrived.count(StreamCount(1, 100)) == 10
    came(arrived, 20)
    assert arrived.count(StreamCount(2, 15)) == 0
    came(arrived, 5)
    assert arrived.count(StreamCount(2, 22)) == 2
    assert arrived.lost == 12
