"""Commands that tell when they were made: what is old, repeated or out of order is not carried out."""

from __future__ import annotations

import random

import pytest
from msgspec import UNSET

from macs_zenoh.protocol.command_clock import AHEAD_S, TICK_S, CommandClocks
from macs_zenoh.protocol.judging import Judge
from macs_zenoh.protocol.messages import CommandClock, Metadata, decode_data, encode_data

SENDER = "unity/300"
NAME = "k3f9a2c1"


def command(time: int, clock: str = NAME, node: str = "nd__cmd_vel") -> Metadata:
    return Metadata(2, 300, time, node_type=2, node_name=node, clock=clock or UNSET)


class Headset:
    """A sender whose clock was 0 when the robot's was ``zero``, and which takes what is on its way so long."""

    def __init__(self, clocks: CommandClocks, zero: float = 90.0, way_s: float = 0.002, rate: float = 1.0) -> None:
        self.clocks, self.zero, self.way_s, self.rate = clocks, zero, way_s, rate

    def ticks(self, now: float) -> int:
        return int((now - self.zero) * self.rate / TICK_S)

    def answer(self, question: CommandClock, now: float) -> CommandClock | None:
        """The robot asked at ``now``; its question and the answer each take the way."""
        said = CommandClock(clock=question.clock, question=question.question, at=self.ticks(now + self.way_s))
        return self.clocks.answered(SENDER, said, now + 2 * self.way_s)

    def greet(self, now: float) -> CommandClock | None:
        return self.answer(self.clocks.hello(SENDER, NAME, now), now)

    def tick(self, now: float) -> None:
        """Answer what the robot asks by now."""
        for _, question in self.clocks.due(now):
            self.answer(question, now)

    def send(self, now: float, waits_s: float = 0.0, **more: str) -> str:
        """A command made at ``now``: why it is not carried out, or nothing."""
        verdict = self.clocks.judge(SENDER, command(self.ticks(now), **more), now + self.way_s + waits_s)
        return verdict.refusal.kind if verdict.refusal else ""


@pytest.fixture
def clocks() -> CommandClocks:
    return CommandClocks(0.2)


def test_the_fields_on_the_wire() -> None:
    """As docs/protocol.md writes them."""
    assert encode_data(CommandClock(clock=NAME)) == b'{"clock":"k3f9a2c1","question":0}'
    question = b'{"clock":"k3f9a2c1","question":7,"known":true,"maxAgeS":0.2}'
    assert decode_data(CommandClock, question) == CommandClock(clock=NAME, question=7, known=True, max_age_s=0.2)
    raw = b'{"senderAgentType":2,"senderAgentId":300,"messageManager":"","requestId":12345,"nodeType":2,'
    raw += b'"nodeName":"nd__cmd_vel","dataExchangeType":"geometry_msgs/Twist","clock":"k3f9a2c1"}'
    assert (Metadata.decode(raw).clock, Metadata.decode(raw).request_id) == (NAME, 12345)
    assert b"clock" not in Metadata(2, 300).encode()


def test_gateways_judge_them_as_fast_as_others() -> None:
    """Only the request id changes: the third of a shape is read by its number, and keeps its clock."""
    judge = Judge(2, 300)
    for time in (100, 200, 300, 400):
        judged = judge(command(time).encode())
        assert (judged.metadata.request_id, judged.metadata.clock) == (time, NAME)
    assert judge._last is not None


@pytest.mark.parametrize("zero", [90.0, -1e6, 99.9])
def test_commands_in_time_pass_and_late_ones_do_not(clocks: CommandClocks, zero: float) -> None:
    """However far the two clocks are apart."""
    headset = Headset(clocks, zero)
    known = headset.greet(100.0)
    assert known is not None
    assert known.known
    assert known.question == 0
    assert [headset.send(100.1), headset.send(100.2, 0.15), headset.send(100.3, 0.3)] == ["", "", "too_old"]
    assert headset.send(100.4) == ""


def test_before_the_clock_is_known_nothing_passes(clocks: CommandClocks) -> None:
    """And nothing of a clock that was never answered by."""
    headset = Headset(clocks)
    assert headset.send(99.0) == "no_clock"
    headset.greet(100.0)
    assert headset.send(99.9) == "out_of_order"  # made before the robot was told the time
    assert headset.send(100.1) == ""
    assert headset.send(100.2, clock="another1") == "no_clock"


def test_what_is_said_twice_or_late_is_refused_by_its_name(clocks: CommandClocks) -> None:
    """Each topic has its own order."""
    headset = Headset(clocks)
    headset.greet(100.0)
    assert [headset.send(100.10), headset.send(100.10), headset.send(100.12)] == ["", "repeated", ""]
    assert [headset.send(100.11), headset.send(100.10)] == ["out_of_order", "repeated"]
    assert headset.send(100.11, node="nd__arm") == ""


def test_a_thousand_replays_of_a_thousand_commands_are_refused(clocks: CommandClocks) -> None:
    """Whenever they come, in whichever order."""
    headset, chance = Headset(clocks), random.Random(1)
    headset.greet(100.0)
    sent = [100.1 + number / 100 for number in range(1000)]
    for at in sent:
        headset.tick(at - 0.005)
        assert headset.send(at) == ""
        again = chance.choice([other for other in sent if other <= at])
        assert headset.send(again, at - again) in ("repeated", "out_of_order")


def test_a_stop_passes_and_what_was_made_before_it_does_not(clocks: CommandClocks) -> None:
    """A velocity of zero is carried out however old, unknown or repeated it is."""
    headset = Headset(clocks)
    assert clocks.judge(SENDER, command(5), 99.0, halts=True).refusal is None
    headset.greet(100.0)
    halt = command(headset.ticks(100.2))
    for _ in range(2):
        assert clocks.judge(SENDER, halt, 101.0, halts=True).refusal is None
    assert headset.send(100.15) == "out_of_order"


@pytest.mark.parametrize(("down_s", "up_s"), [(0.3, 0.0), (0.0, 0.3), (0.15, 0.15)])
def test_slow_ways_never_make_a_command_younger(clocks: CommandClocks, down_s: float, up_s: float) -> None:
    """The bound is never less than the true age, whichever way took long when the clock was asked."""
    headset = Headset(clocks, way_s=0.0)
    question = clocks.hello(SENDER, NAME, 100.0)
    said = CommandClock(clock=NAME, question=question.question, at=headset.ticks(100.0 + down_s))
    assert clocks.answered(SENDER, said, 100.0 + down_s + up_s) is not None
    for number in range(100):
        made, waited = 101 + number / 50, number / 200
        verdict = clocks.judge(SENDER, command(headset.ticks(made)), made + waited)
        assert verdict.age_s >= waited - TICK_S
        assert (verdict.refusal is None) == (verdict.age_s <= 0.2)


def test_an_answer_counts_once_and_only_what_was_asked(clocks: CommandClocks) -> None:
    """Who repeats answers, makes some up or answers for another clock changes nothing."""
    headset = Headset(clocks)
    question = clocks.hello(SENDER, NAME, 100.0)
    for number in (question.question + 2, 1):
        assert clocks.answered(SENDER, CommandClock(clock=NAME, question=number, at=1), 100.0) is None
    assert clocks.answered(SENDER, CommandClock(clock="another1", question=question.question, at=1), 100.0) is None
    assert headset.answer(question, 100.0) is not None
    assert clocks.answered(SENDER, CommandClock(clock=NAME, question=question.question, at=1), 100.1) is None
    assert headset.send(100.2) == ""


def test_a_time_to_come_is_no_time(clocks: CommandClocks) -> None:
    """Who makes his commands later than now is not known any more, until he answers again."""
    headset = Headset(clocks)
    headset.greet(100.0)
    assert headset.send(100.1 + 2 * AHEAD_S, waits_s=-2 * AHEAD_S) == "no_clock"
    assert headset.send(100.2) == "no_clock"
    headset.greet(100.3)
    assert headset.send(100.4) == ""


def test_a_clock_that_does_not_answer_any_more_is_not_known(clocks: CommandClocks) -> None:
    """It may have been set, or somebody keeps the answers back."""
    headset = Headset(clocks)
    headset.greet(100.0)
    assert headset.send(104.9) == ""
    assert headset.send(105.2) == "no_clock"


@pytest.mark.parametrize("shift_s", [-30.0, 30.0])
def test_a_clock_that_was_set_is_compared_anew(clocks: CommandClocks, shift_s: float) -> None:
    """At its next answer: one that stood still while the device slept, or was put forward."""
    headset = Headset(clocks)
    headset.greet(100.0)
    assert headset.send(100.1) == ""
    headset.zero -= shift_s
    headset.tick(140.0)
    assert headset.send(140.1, 0.3) == "too_old"
    assert headset.send(140.5) == ""


@pytest.mark.parametrize("rate", [1 + 4e-4, 1 - 4e-4])
def test_clocks_may_drift(clocks: CommandClocks, rate: float) -> None:
    """For an hour, asked each second."""
    headset = Headset(clocks, rate=rate)
    headset.greet(100.0)
    for number in range(1, 3600):
        now = 100.0 + number
        headset.tick(now)
        assert headset.send(now + 0.5) == ""
        assert headset.send(now + 0.6, 0.21) == "too_old"


def test_one_clock_after_the_other(clocks: CommandClocks) -> None:
    """A page that was loaded again has a new one; a replayed hello of the old one changes nothing."""
    headset = Headset(clocks)
    headset.greet(100.0)
    assert headset.send(100.1) == ""
    clocks.hello(SENDER, "another1", 100.2)
    assert headset.send(100.3) == ""
    question = clocks.hello(SENDER, "another1", 100.4)
    said = CommandClock(clock="another1", question=question.question, at=headset.ticks(100.4))
    assert clocks.answered(SENDER, said, 100.41) is not None
    assert headset.send(100.5) == "no_clock"
    assert headset.send(100.6, clock="another1") == ""


def test_who_tells_the_time_tells_it_always(clocks: CommandClocks) -> None:
    """A relay cannot take the time out of what it repeats; who never told it is not concerned."""
    headset = Headset(clocks)
    headset.greet(100.0)
    untimed = Metadata(2, 300, node_type=2, node_name="nd__cmd_vel")
    refused = clocks.judge(SENDER, untimed, 100.1).refusal
    assert refused is not None
    assert refused.kind == "no_clock"
    assert clocks.judge("unity/301", untimed, 100.1).refusal is None
    clocks.left(SENDER)
    assert clocks.judge(SENDER, untimed, 100.2).refusal is None


def test_each_is_asked_once_a_second_while_he_commands(clocks: CommandClocks) -> None:
    """And not for ever, so that whoever leaves a clock behind costs nothing."""
    headset = Headset(clocks)
    headset.greet(100.0)
    assert not clocks.due(100.5)
    assert len(clocks.due(101.0)) == 1
    assert not clocks.due(101.5)
    headset.send(150.0)
    assert len(clocks.due(200.0)) == 1
    assert not clocks.due(300.0)
    assert not clocks.wanted


def test_names_that_somebody_makes_up_cost_little(clocks: CommandClocks) -> None:
    """Of senders, of clocks and of nodes; and what was forgotten of a node cannot be replayed."""
    headset = Headset(clocks)
    headset.greet(100.0)
    assert headset.send(100.1) == ""
    for number in range(5000):
        clocks.hello(f"unity/{number}", NAME, 100.1)
        clocks.hello(SENDER, f"clock{number:04}", 100.1)
    assert len(clocks._clocks) + len(clocks._others) <= CommandClocks.SENDERS + 1
    for number in range(200):
        headset.send(100.1, node=f"nd_{number}")
    assert headset.send(100.1) == "out_of_order"
    assert headset.send(100.15) == ""
