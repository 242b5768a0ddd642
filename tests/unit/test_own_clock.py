"""The clock of a headset: who is told of it, how soon again, and which commands carry its time."""

from __future__ import annotations

import asyncio
from collections.abc import Collection

import pytest

from bridge.headset.own_clock import OwnClock
from macs_zenoh.protocol.messages import CommandClock, decode_data, encode_data
from tests.support.waiting import until


class Told:
    """What a clock says, and the time that it sees, in s."""

    def __init__(self) -> None:
        self.now = 100.0
        self.hellos: list[tuple[list[int], list[int]]] = []
        self.answers: list[int] = []
        self.clock = OwnClock(self._say, lambda: self.now)

    async def _say(self, data: bytes, robots: Collection[int], groups: Collection[int]) -> None:
        if decode_data(CommandClock, data).question:
            self.answers.extend(robots)
        else:
            self.hellos.append((list(robots), list(groups)))

    async def asks(self, robot: int) -> None:
        await self.clock.take(robot, encode_data(CommandClock(clock=self.clock.name, question=5, known=True)))


@pytest.fixture
def told() -> Told:
    return Told()


def test_commands_to_groups_carry_the_time_as_soon_as_anybody_is_told(told: Told) -> None:
    """Robot 7 may be a member of group 3, and refuses what has none."""
    assert not told.clock.tells([7], [])
    assert not told.clock.tells([], [3])
    told.clock.robots.add(7)
    assert told.clock.tells([7], [])
    assert told.clock.tells([], [3])
    assert told.clock.tells([9], [3])
    assert not told.clock.tells([9], []), "nobody has told 9 of a clock"


async def test_a_robot_that_has_asked_is_told_the_time(told: Told) -> None:
    """It was told of the clock in a group, and commands may be for it alone."""
    told.clock.groups.add(3)
    assert not told.clock.tells([7], [])
    await told.asks(7)
    assert told.clock.tells([7], [])


@pytest.mark.parametrize("groups", [{3}, set()])
async def test_a_robot_that_refuses_hears_hello_within_a_second(told: Told, groups: set[int]) -> None:
    """Also one that nobody named: it was in a group when it was commanded."""
    told.clock.robots, told.clock.groups = {7}, groups
    await told.clock.hello()
    await told.asks(7)
    keeps = asyncio.create_task(told.clock.keep_known())
    told.clock.unknown(9)
    told.now += 1.0
    try:
        await until(lambda: len(told.hellos) == 2)
    finally:
        keeps.cancel()
    assert told.hellos[1] == ([7, 9], sorted(groups))
    await told.clock.hello()
    assert told.hellos[2] == ([7], sorted(groups)), "once, unless it refuses again"


async def test_more_than_a_message_can_be_for_are_told_in_several(told: Told) -> None:
    """Ten robots and ten groups fit into one."""
    told.clock.robots, told.clock.groups = set(range(1, 24)), set(range(1, 13))
    await told.clock.hello()
    assert [len(robots) for robots, _ in told.hellos] == [10, 10, 3]
    assert [len(groups) for _, groups in told.hellos] == [10, 2, 0]
