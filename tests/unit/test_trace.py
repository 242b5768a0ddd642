"""The way of one message, hop by hop: marks, reports, clocks and what follows from them."""

from __future__ import annotations

import pytest

from macs_zenoh.errors import BadField, BadJson, TooLong, WireError
from macs_zenoh.protocol import trace
from macs_zenoh.protocol.trace import (
    DONE,
    IN,
    NOTES,
    PUT,
    RECEIVED,
    ROS_SENT,
    ROUTER,
    SENT,
    TAKEN,
    Offset,
    Point,
    Report,
    TraceAnswer,
    TraceRequest,
)

MS = 1_000_000
NAMES = {"r": "robot 7", "g": "gateway"}


def way(*at_ms: float, middle: str = "x") -> list[Point]:
    sender = [(name, "r") for name in (ROS_SENT, TAKEN, PUT, SENT)]
    places = [*sender, (ROUTER, middle), *((name, "g") for name in (RECEIVED, IN, DONE))]
    return [Point(name, round(at * MS), clock) for (name, clock), at in zip(places, at_ms, strict=True)]


def test_hops_add_up_to_the_whole() -> None:
    """Each has a name that says where the time went."""
    points = way(0, 1, 1.5, 2, 5, 9, 9.5, 10)
    hops = list(trace.hops(points, NAMES))
    assert [(hop.name, hop.took_ns / MS) for hop in hops] == [
        ("robot 7: ROS to its agent", 1),
        ("robot 7: agent", 0.5),
        ("robot 7: into Zenoh", 0.5),
        ("robot 7 to router x", 3),
        ("router x to gateway", 4),
        ("gateway: out of Zenoh", 0.5),
        ("gateway: handled", 0.5),
    ]
    assert sum(hop.took_ns for hop in hops) == points[-1].at_ns - points[0].at_ns
    assert trace.at_share([1, 2, 3, 4], 0.5) == 2
    assert trace.at_share([1, 2, 3, 4], 0.99) == 4


def test_a_clock_that_is_known_is_allowed_for() -> None:
    """Of a program by its offset; the sum is that of the true times then."""
    points = way(0, 1, 1.5, 2, 105, 109, 109.5, 110, middle="g")
    corrected = trace.corrected(points, {"g": Offset(100 * MS, 0.1 * MS)})
    assert corrected[-1].at_ns == 10 * MS
    assert corrected[0] == points[0]


def test_the_order_of_points_bounds_a_routers_clock() -> None:
    """No difference is assumed where that is possible; else the middle of what is."""
    true = [way(0, 1, 1.5, 2, 5, 9, 9.5, 10), way(0, 1, 1.5, 2, 3, 4, 5, 6)]
    assert trace.bound_by_order(true, "x") == Offset(0.0, 1 * MS)
    ahead = [way(0, 1, 1.5, 2, 105, 9, 9.5, 10), way(0, 1, 1.5, 2, 103, 4, 5, 6)]
    bound = trace.bound_by_order(ahead, "x")
    assert bound.ahead_ns == 100 * MS
    assert bound.within_ns == pytest.approx(1 * MS)
    assert trace.bound_by_order(true, "unknown") == Offset()
    assert trace.bound_by_order([], "x") == Offset()


def test_marks_are_read_as_they_were_written() -> None:
    """And what others attach is none."""
    notes = [(name, 1_700_000_000_000_000_000 + at) for at, name in enumerate(NOTES)]
    mark = trace.encode_mark(12345, notes)
    assert trace.decode_mark(mark) == (12345, notes)
    assert len(mark) < 64
    for wrong in (b"", mark[:-1], mark + b"x", b"xxxx" + mark[4:], b"\x00" * 600, mark[:13] + b"\xff" + mark[14:]):
        assert trace.decode_mark(wrong) is None


def test_requests_and_answers_are_bounded() -> None:
    """What somebody asks for costs a program a bounded amount, whatever it is."""
    asked = TraceRequest("macs/from/ros/7/nd__pose", 10, seconds=5, after=3)
    assert trace.decode_request(trace.encode_request(asked)) == asked
    for wrong, error in (
        (b"{", BadJson),
        (b"[]", BadJson),
        (b'{"every": 0}', BadField),
        (b'{"seconds": 1e9}', BadField),
        (b'{"seconds": -1}', BadField),
        (b'{"put": "' + b"a" * 5000 + b'"}', TooLong),
    ):
        with pytest.raises(error):
            trace.decode_request(trace.PREFIX + wrong)
    reports = [Report(number, 1, "k" * 200, "loop", [("put", 1, "c" * 32)] * 20) for number in range(1000)]
    told = trace.encode_answer(TraceAnswer(reports))
    assert len(told) <= trace.ANSWER_BYTES
    read = trace.decode_answer(told)
    assert read.reports == reports[: len(read.reports)]
    assert trace.decode_answer(trace.encode_request(asked)) == TraceAnswer()
    for wrong in (b"{", b"[1]", b'{"reports": [[1]]}', b"\xff"):
        with pytest.raises(WireError):
            trace.decode_answer(wrong)


@pytest.mark.parametrize("number", [-1, 1 << 63])
def test_numbers_and_times_that_are_none(number: int) -> None:
    """What a program tells may be made up: an answer with such a time, or such a count, is none."""
    for report in (
        Report(1, 2, "macs/from/ros/7/nd__x", "loop", [(PUT, number, "ab")]),
        Report(number, 2, "macs/from/ros/7/nd__x", "loop", []),
    ):
        with pytest.raises(BadJson):
            trace.decode_answer(trace.encode_answer(TraceAnswer([report])))
