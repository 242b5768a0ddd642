"""What senders that somebody makes up cost a robot that asks when commands were made: little, and nobody else."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.command_clock import CommandClocks
from macs_zenoh.protocol.messages import CommandClock
from tests.unit.test_command_clock import NAME, SENDER, Headset, command

MADE_UP = 5000


@pytest.fixture
def clocks() -> CommandClocks:
    return CommandClocks(0.2)


def made_up(clocks: CommandClocks, number: int, now: float) -> str:
    """A sender that says hello and answers, which costs it two messages."""
    sender = f"unity/{1000 + number}"
    question = clocks.hello(sender, NAME, now)
    clocks.answered(sender, CommandClock(clock=NAME, question=question.question, at=7), now)
    return sender


def test_no_more_are_kept_than_have_a_place(clocks: CommandClocks) -> None:
    """Who has answered has a place as long as there is one; who has not commanded for longest gives it up. Whoever
    commands keeps it, though all the others came after him."""
    headset = Headset(clocks)
    headset.greet(100.0)
    assert headset.send(100.1) == ""
    for number in range(MADE_UP):
        now = 100.1 + number / MADE_UP * 4
        made_up(clocks, number, now)
        assert len(clocks._clocks) <= CommandClocks.SENDERS
    assert headset.send(104.2) == ""
    newest = f"unity/{1000 + MADE_UP - 1}"
    assert clocks.judge(newest, command(8), 104.2).refusal is None
    oldest = clocks.judge("unity/1000", command(8), 104.2).refusal
    assert oldest is not None
    assert oldest.kind == "no_clock"


def test_where_all_command_nobody_is_displaced(clocks: CommandClocks) -> None:
    """One more is not known until somebody has stopped commanding; then he is."""
    for number in range(CommandClocks.SENDERS):
        sender = made_up(clocks, number, 100.0)
        assert clocks.judge(sender, command(1007), 100.1).refusal is None
    headset = Headset(clocks)
    assert headset.greet(101.0) is None
    assert headset.send(101.1) == "no_clock"
    known = [name for name, question in clocks.due(101.2) if question.known]
    assert SENDER not in known
    for number in range(CommandClocks.SENDERS):
        assert clocks.judge(f"unity/{1000 + number}", command(11_007), 101.1).refusal is None
    assert headset.greet(101.1 + CommandClocks.COMMANDS_S + 1) is not None


def test_however_many_there_are_a_look_asks_few(clocks: CommandClocks) -> None:
    """Whoever commands is asked each second or little later all the while, and of the others each has his turn."""
    headset = Headset(clocks)
    headset.greet(100.0)
    for number in range(MADE_UP):
        made_up(clocks, number, 100.0)
        clocks.hello(f"unity/{10_000 + number}", NAME, 100.0)
        if number % 500 == 0:
            assert headset.send(100.1 + number / MADE_UP) == ""
    asked: set[str] = set()
    own = 0
    for look in range(160):
        now = 101.5 + look / 4
        questions = clocks.due(now)
        assert len(questions) <= 2 * CommandClocks.LOOKED_AT
        asked.update(name for name, _ in questions)
        for name, question in questions:
            if name == SENDER:
                own += 1
                headset.answer(question, now)
        assert headset.send(now + 0.1) == "", now
    assert len(asked) == 2 * CommandClocks.SENDERS
    assert own >= 30


def test_who_commands_by_a_clock_that_is_not_known_is_asked(clocks: CommandClocks) -> None:
    """He may have said hello before the robot was there."""
    headset = Headset(clocks)
    assert headset.send(100.0) == "no_clock"
    headset.tick(100.1)
    assert headset.send(100.2) == ""
