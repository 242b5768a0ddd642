"""How long senders are held while what they send to is full."""

from __future__ import annotations

import asyncio

import pytest

from bridge.gateway import backpressure
from bridge.gateway.backpressure import CALM_S, HELD_S, HOLD_S, ROBOT_HOLD_S, STOPPED_S, Backpressure, Patience


class Clock:
    """A loop whose time is told."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._due: list[tuple[float, asyncio.TimerHandle]] = []

    def time(self) -> float:
        return self.now_s

    def call_later(self, delay_s: float, callback, *args) -> asyncio.TimerHandle:  # type: ignore[no-untyped-def]
        handle = asyncio.TimerHandle(self.now_s + delay_s, callback, args, self)  # type: ignore[arg-type]
        self._due.append((self.now_s + delay_s, handle))
        return handle

    def pass_time(self, seconds: float) -> None:
        """Call what is due meanwhile."""
        until_s = self.now_s + seconds
        while due := sorted((at for at in self._due if at[0] <= until_s), key=lambda at: at[0]):
            self._due.remove(due[0])
            self.now_s, handle = due[0]
            if not handle.cancelled():
                handle._run()
        self.now_s = until_s

    def get_debug(self) -> bool:
        return False

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None:
        pass


class Sender:
    """Counts."""

    def __init__(self) -> None:
        self.held = 0
        self.patience = Patience()

    def pause(self) -> None:
        self.held += 1

    def resume(self) -> None:
        self.held -= 1


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(backpressure.asyncio, "get_running_loop", lambda: clock)
    return clock


def test_a_sender_is_held_for_a_moment_at_a_time(clock: Clock) -> None:
    """Until there is room, and no longer than a moment; then the next frame has it held again."""
    bottleneck, sender = Backpressure(), Sender()
    assert bottleneck.hold(sender, 1)
    assert bottleneck.hold(sender, 1)
    assert (sender.held, bottleneck.holds) == (1, True)
    bottleneck.release()
    assert (sender.held, bottleneck.holds) == (0, False)
    assert bottleneck.hold(sender, 2)
    clock.pass_time(HOLD_S)
    assert (sender.held, bottleneck.holds) == (0, False)


def test_who_stands_still_for_less_than_a_second_has_not_stopped(clock: Clock) -> None:
    """Senders are held again and again; after a second of it no more, until the bottleneck moves."""
    bottleneck, sender = Backpressure(), Sender()
    held_s = 0.0
    while bottleneck.hold(sender, 1):
        clock.pass_time(HOLD_S)
        held_s += HOLD_S
    assert held_s == STOPPED_S
    clock.pass_time(10.0)
    assert not bottleneck.hold(sender, 1)
    assert bottleneck.hold(sender, 2)


def test_a_robot_program_is_held_for_that_second_at_once(clock: Clock) -> None:
    """And then no more for who stands still."""
    bottleneck, robot = Backpressure(), Sender()
    assert bottleneck.hold(robot, 1, ROBOT_HOLD_S)
    clock.pass_time(ROBOT_HOLD_S)
    assert robot.held == 0
    assert not bottleneck.hold(robot, 1, ROBOT_HOLD_S)


MANY = 20


def held_by(clock: Clock, sender: Sender, places: list[Backpressure], frames: int, moves: bool) -> float:
    """For how long a sender is held that sends frames to these in turn, as soon as it is read from."""
    held_s = 0.0
    for number in range(frames):
        if places[number % len(places)].hold(sender, number if moves else 0):
            clock.pass_time(HOLD_S)
            held_s += HOLD_S
        assert sender.held == 0
    return held_s


def test_many_that_stand_still_hold_a_sender_for_a_second_together(clock: Clock) -> None:
    """However many it sends to in turn: what comes behind, a stop maybe, waits no longer. Each held it for a second.
    Later they may again, once they have moved."""
    places, sender, other = [Backpressure() for _ in range(MANY)], Sender(), Sender()
    assert held_by(clock, sender, places, 10 * MANY, moves=False) == HELD_S
    assert held_by(clock, other, places[-1:], 10, moves=False) == HELD_S  # each sender for itself
    clock.pass_time(CALM_S)
    assert not places[0].hold(sender, 0)
    assert places[0].hold(sender, 1)


def test_at_the_same_time_they_count_once(clock: Clock) -> None:
    """A frame to many in one Wi-Fi that stands still: its sender is held until they have stopped."""
    places, sender = [Backpressure() for _ in range(MANY)], Sender()
    held_s = 0.0
    while sum(place.hold(sender, 0) for place in places):
        assert sender.held == MANY
        clock.pass_time(HOLD_S)
        assert sender.held == 0
        held_s += HOLD_S
    assert held_s == STOPPED_S


def test_those_that_move_hold_a_sender_as_often_as_they_are_full(clock: Clock) -> None:
    """Receivers that are merely slower get the time that they need, however many they are; so do they who say that
    they have moved before the next frame comes."""
    places, sender = [Backpressure() for _ in range(3)], Sender()
    assert held_by(clock, sender, places, 30 * MANY, moves=True) == 30 * MANY * HOLD_S
    for _ in range(MANY):
        place = Backpressure()
        assert held_by(clock, sender, [place], 1, moves=True) == HOLD_S
        place.has_moved()


def test_one_that_stands_still_takes_nothing_from_one_that_is_slower(clock: Clock) -> None:
    """Of two receivers one has stopped, and the other moves: that one is waited for as before, but for the first look
    at it, from which nobody knows."""
    stopped, slower, sender = Backpressure(), Backpressure(), Sender()
    assert held_by(clock, sender, [stopped], 10, moves=False) == HELD_S
    assert held_by(clock, sender, [slower], 1 + MANY, moves=True) == MANY * HOLD_S
