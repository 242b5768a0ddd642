"""Traffic rules: which hold for a key, what passes, and that every drop is counted under its rule, reason and key."""

from __future__ import annotations

import itertools
import threading
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from macs_zenoh.config import TrafficRule
from macs_zenoh.protocol import policing as shaping
from macs_zenoh.protocol.policing import BURST_S, OTHER_KEYS, Policer, Policy
from macs_zenoh.protocol.rate import Rate

CAMERA = "macs/from/ros/7/nd__camera_front"
OTHER_CAMERA = "macs/from/ros/7/nd__camera_back"
CAMERAS = "macs/from/ros/*/nd__camera$*"


def shape_of(*rules: TrafficRule, key: str = CAMERA) -> Policy:
    shape = Policer(rules).of(key)
    assert shape is not None
    return shape


def passed(shape: Policy, times: list[float], size: int = 100) -> list[float]:
    """Those of the times at which a message passes."""
    return [now for now in times if shape.judge(size, now) is None]


# -- which rules hold ------------------------------------------------------------------------------------------------


def test_without_rules_no_key_has_a_shape() -> None:
    """Nothing is looked up or kept where nothing is configured."""
    policer = Policer()
    assert policer.of(CAMERA) is None
    assert policer.report() == []


def test_a_key_that_no_rule_fits_has_no_shape() -> None:
    """Rules for other keys leave a key alone."""
    assert Policer([TrafficRule(match=CAMERAS, max_hz=5)]).of("macs/from/ros/7/nd__map") is None


def test_each_setting_comes_from_the_first_rule_that_gives_it() -> None:
    """A rule in front adds to or replaces single settings of those behind, and leaves the others."""
    shape = shape_of(
        TrafficRule(match=CAMERAS, priority="data_low"),
        TrafficRule(match="macs/from/**", priority="background", max_bytes=500, cache=3),
        TrafficRule(match="**", max_bytes=100, cache=9),
    )
    assert (shape.priority, shape.cache) == ("data_low", 3)
    assert shape.judge(500, 0.0) is None
    over = shape.judge(501, 0.0)
    assert over is not None
    assert (over.reason, over.rule, over.setting, over.limit) == ("over_size", "macs/from/**", "max_bytes", 500)


def test_a_rule_without_limits_refuses_nothing() -> None:
    """Where only priority or reliability is set, the messages need not be counted one by one."""
    shape = shape_of(TrafficRule(match="**", priority="data_low", cache=5))
    assert not shape.limited
    assert passed(shape, [0.0] * 1000, size=1 << 20) == [0.0] * 1000


# -- limits ----------------------------------------------------------------------------------------------------------


def test_a_rate_thins_out_evenly() -> None:
    """Of 30 messages per second at most 10 pass, one in three, not ten in a row and then none."""
    shape = shape_of(TrafficRule(match="**", max_hz=10))
    times = passed(shape, [number / 30 for number in range(300)])
    assert 100 <= len(times) <= 102
    pauses = [after - before for before, after in itertools.pairwise(times[3:])]
    assert max(pauses) < 0.14


def test_a_sender_at_the_rate_loses_nothing() -> None:
    """A camera with exactly the allowed rate passes, though its messages come a little early and late by turns."""
    shape = shape_of(TrafficRule(match="**", max_hz=30))
    times = [number / 30 + (0.02 if number % 2 else 0.0) for number in range(300)]
    assert passed(shape, times) == times


def test_a_pause_saves_nothing_up() -> None:
    """After a minute of silence as much passes at once as after a second."""
    for silence_s in (1.0, 60.0):
        shape = shape_of(TrafficRule(match="**", max_hz=105))
        assert shape.judge(1, 0.0) is None
        assert len(passed(shape, [silence_s] * 50)) == 1 + int(105 * BURST_S)


@settings(deadline=None)
@given(
    times=st.lists(st.floats(0, 20), max_size=80).map(sorted),
    hz=st.floats(0.5, 200),
    size=st.integers(1, 100_000),
    budget=st.integers(1000, 1_000_000),
)
def test_no_span_of_time_holds_more_than_allowed(times: list[float], hz: float, size: int, budget: int) -> None:
    """In any span, however messages come, no more pass than rate times span, the burst and one message."""
    shape = shape_of(TrafficRule(match="**", max_hz=hz, max_bytes_per_s=budget))
    times = passed(shape, times, size)
    for first in range(len(times)):
        for last in range(first, len(times)):
            span_s, count = times[last] - times[first], last - first + 1
            assert count <= hz * (span_s + BURST_S) + 1 + 1e-6
            assert count * size <= budget * (span_s + BURST_S) + size + 1e-3


def test_a_rate_holds_for_each_key_and_a_budget_for_all() -> None:
    """Two cameras under one rule each have its rate, and share its budget."""
    policer = Policer([TrafficRule(match=CAMERAS, max_hz=1), TrafficRule(match="macs/from/**", max_bytes_per_s=1000)])
    front, back = policer.of(CAMERA), policer.of(OTHER_CAMERA)
    assert front is not None
    assert back is not None

    def why_not(shape: Policy, size: int, now: float) -> str | None:
        over = shape.judge(size, now)
        return None if over is None else over.reason

    assert why_not(front, 50, 0.0) is None
    assert why_not(back, 2000, 0.0) is None
    assert why_not(front, 50, 0.5) == "over_rate"
    assert why_not(front, 50, 1.5) == "over_budget"  # the other one has used 2 s of it
    assert why_not(front, 50, 2.0) is None


def test_a_message_above_the_budget_of_a_second_passes_now_and_then() -> None:
    """A message larger than the budget is not shut out for ever: it uses up what the next seconds have."""
    shape = shape_of(TrafficRule(match="**", max_bytes_per_s=1000))
    assert passed(shape, [float(second) for second in range(20)], size=5000) == [0.0, 5.0, 10.0, 15.0]


def test_what_one_limit_drops_costs_the_others_nothing() -> None:
    """A message that is too large takes nothing of the rate, and one that is too early nothing of the budget."""
    shape = shape_of(TrafficRule(match="**", max_hz=1, max_bytes=100, max_bytes_per_s=1000))
    assert [shape.judge(101, 0.0) is None for _ in range(5)] == [False] * 5
    assert shape.judge(100, 0.0) is None
    assert [shape.judge(100, 0.5) is None for _ in range(20)] == [False] * 20
    assert shape.judge(100, 1.0) is None


def test_time_that_stands_still_or_runs_back_is_no_fault() -> None:
    """Threads bring their times in any order; a pace neither breaks nor opens."""
    pace = Rate(10, BURST_S)
    pace.take(1, 5.0)
    assert pace.allows(4.99 + BURST_S)
    pace.take(1, 4.9)
    assert not pace.allows(5.0)


# -- what is counted -------------------------------------------------------------------------------------------------


def test_every_drop_is_counted_by_rule_reason_and_key() -> None:
    """What passes and what is counted is together what came; the first of a rule and reason says that it is."""
    totals: Counter[str] = Counter()
    policer = Policer([TrafficRule(match=CAMERAS, max_hz=10, max_bytes=1000)], totals)
    overruns = []
    for key in (CAMERA, OTHER_CAMERA):
        shape = policer.of(key)
        assert shape is not None
        overruns += [shape.judge(size, 0.0) for size in [1] * 10 + [1001] * 3]
    dropped = [over for over in overruns if over is not None]
    assert [(over.reason, over.first) for over in dropped if over.first] == [("over_rate", True), ("over_size", True)]
    assert totals == {"over_rate": 16, "over_size": 6}
    assert policer.drops == {
        (CAMERAS, "over_rate", CAMERA): 8,
        (CAMERAS, "over_rate", OTHER_CAMERA): 8,
        (CAMERAS, "over_size", CAMERA): 3,
        (CAMERAS, "over_size", OTHER_CAMERA): 3,
    }
    assert policer.report() == [
        f"traffic rule {CAMERAS}: over_rate 16, on {CAMERA} 8, {OTHER_CAMERA} 8",
        f"traffic rule {CAMERAS}: over_size 6, on {CAMERA} 3, {OTHER_CAMERA} 3",
    ]


def test_a_call_is_judged_by_its_size_alone() -> None:
    """What has to be answered is not lost to a rate; only a size above the limit is refused, and counted."""
    shape = shape_of(TrafficRule(match="**", max_hz=1, max_bytes=100))
    assert [shape.too_large(100) for _ in range(10)] == [None] * 10
    over = shape.too_large(101)
    assert over is not None
    assert over.limit == 100
    assert shape.judge(1, 0.0) is None


def test_keys_from_the_network_are_not_remembered_for_ever() -> None:
    """However many keys come, what is kept of them is bounded, and the counts stay true."""
    policer = Policer([TrafficRule(match="**", max_bytes=1)])
    number = 2 * Policer.KEYS
    for agent_id in range(number):
        shape = policer.of(f"macs/to/ros/0/{agent_id}")
        assert shape is not None
        assert shape.judge(2, 0.0) is not None
    assert len(policer.drops) == Policer.KEYS + 1
    assert policer.drops["**", "over_size", OTHER_KEYS] == number - Policer.KEYS
    assert policer.totals == {"over_size": number}
    assert policer.report()[0].endswith(f"and {Policer.KEYS - 4} keys more")


def test_a_key_that_no_rule_fits_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rules are not asked again for each message of a key that they leave alone, and any number of such keys
    pushes the pace of no other one out."""
    asked: Counter[str] = Counter()

    def fits(match: str, key: str) -> bool:
        asked[key] += 1
        return key == match

    monkeypatch.setattr(shaping, "fits", fits)
    policer = Policer([TrafficRule(match=CAMERA, max_hz=5)])
    shape = policer.of(CAMERA)
    for number in range(2 * Policer.KEYS):
        for _ in range(3):
            assert policer.of(f"macs/to/ros/0/{number}") is None
    assert set(asked.values()) == {1}
    assert policer.of(CAMERA) is shape
    assert len(policer._free) == Policer.KEYS


def test_threads_share_a_rate() -> None:
    """Several threads at once get no more through than one, and each drop is counted."""
    totals: Counter[str] = Counter()
    policer = Policer([TrafficRule(match="**", max_hz=100)], totals)
    went = [0] * 4
    begin = threading.Barrier(4)

    def send(thread: int) -> None:
        shape = policer.of(CAMERA)
        assert shape is not None
        begin.wait()
        for _ in range(2000):
            went[thread] += shape.judge(1, 7.0) is None

    threads = [threading.Thread(target=send, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(went) == 11
    assert totals == {"over_rate": 8000 - 11}
