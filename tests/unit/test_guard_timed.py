"""Commands that tell when they were made, judged by the robot's `Guard`: what their greatest age is used for."""

from __future__ import annotations

from bridge.ros.safety import DeadMan
from macs_zenoh.protocol.command_clock import TICK_S
from macs_zenoh.protocol.guard import Guard, Limits
from macs_zenoh.protocol.messages import CommandClock, Metadata
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.routing import unicast_key
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message

KEY = unicast_key(1, 7, 2, 300)
NAME = "k3f9a2c1"
WAY_S = 0.095
"""Each way: there and back takes 190 ms, of the 200 ms that a command may be old."""


def timed(at: float, node: str = "nd__cmd_vel") -> bytes:
    """A command that was made then."""
    metadata = Metadata(2, 300, int(at / TICK_S), node_type=2, node_name=node, clock=NAME)
    return encode_frame(1, (7,), message=encode_message(metadata.encode(), b"\0\1\0\0\1"))


def known_by(max_age_s: float) -> tuple[Guard, list[Message]]:
    """A guard that has asked once, at 10.0, and what it has carried out."""
    guard, taken = Guard(Limits(1000, 1000, 0.5, max_age_s), MACS), list[Message]()
    guard.me, guard.on_command = (1, 7), taken.append
    question = guard.clocks.hello("unity/300", NAME, 10.0).question
    answer = CommandClock(clock=NAME, question=question, at=int((10.0 + WAY_S) / TICK_S))
    assert guard.clocks.answered("unity/300", answer, 10.0 + 2 * WAY_S) is not None
    return guard, taken


def test_a_long_way_does_not_trip_the_dead_man_between_commands() -> None:
    """Ten commands a second, none of which waits, over a way of 190 ms there and back: a dead-man of 0.25 s counts
    from when each came. How old they may be is held to the limit alone."""
    guard, taken = known_by(0.2)
    deadman = DeadMan(0.25)
    for number in range(40):
        came = 10.3 + number / 10
        assert not deadman.tick(came)
        assert guard.first(KEY, timed(came - WAY_S), 0.0, came)
        assert len(taken) == number + 1
        deadman.command("unity/300", came - taken[-1].age_s)
        assert 2 * WAY_S - 2 * TICK_S < taken[-1].at_most_s <= 0.2
    assert guard.first(KEY, timed(14.4 - WAY_S - 0.05), 0.0, 14.4)
    assert len(taken) == 40, "50 ms more are too many"


def test_what_has_waited_on_its_way_is_as_old_for_the_dead_man() -> None:
    """By the stamps of the first router, as for headsets that tell no time."""
    guard, taken = known_by(5.0)
    assert guard.first(KEY, timed(10.3), 0.4, 10.3 + WAY_S + 0.4)
    assert taken[0].age_s == 0.4
    assert taken[0].at_most_s > 0.4 + WAY_S


def test_a_release_after_a_stop_is_not_overtaken_by_a_long_way() -> None:
    """One that came 100 ms after its sender asked for the stop, and did not wait, was made after it."""
    guard, taken = known_by(5.0)
    guard.stop_name = "nd__emergency_stop"
    guard.pressed((2, 300), 10.5)
    assert guard.first(KEY, timed(10.6, "nd__cmd_vel"), 0.0, 10.6 + WAY_S)
    release = taken[0]._replace(metadata=Metadata(2, 300, node_type=2, node_name=guard.stop_name, clock=NAME))
    assert not guard.overtaken(release, 10.6)
