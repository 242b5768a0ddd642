"""A release is another right than a stop, and `macs stop` says so when a stop does not last."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from bridge.ros.safety import EmergencyStop
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.robot_state import release
from tests.ros.driven import STOPPED, driving, hear, may_command, send_bool, site
from tests.support.programs import ended
from tests.support.ros_peer import Peer
from tests.support.waiting import until

OPEN = """
[robot]
release_allow = ["*"]
"""


# -- pure ------------------------------------------------------------------------------------------------------------


def test_a_stop_ends_when_all_have_taken_it_back() -> None:
    """Of two who stopped, neither lets the robot go on alone; whoever left cannot any more."""
    stop = EmergencyStop()
    assert stop.press("a", 1)
    assert not stop.press("b", 2)
    assert not stop.take_back("a", 3)
    assert not stop.take_back("c", 3)
    assert (stop.stopped, stop.pressed) == (True, ["b"])
    stop.left("b")
    assert not stop.take_back("b", 4)
    assert stop.stopped
    assert stop.release("operator/5", 5)
    assert (stop.stopped, stop.by, stop.times) == (False, "operator/5", 1)
    assert stop.history == ["stopped by a", "released by operator/5"]


def test_pressing_is_bounded() -> None:
    """However many stop, what is kept of them is not more than it says; the robot stays stopped."""
    stop = EmergencyStop()
    for number in range(1000):
        stop.press(f"unity/{number}", 0)
    assert len(stop.pressed) == EmergencyStop.PRESSED
    assert not stop.take_back("unity/999", 1)
    assert stop.stopped


# -- with processes --------------------------------------------------------------------------------------------------


@pytest.fixture
async def flood() -> AsyncIterator[list[asyncio.Task[None]]]:
    tasks: list[asyncio.Task[None]] = []
    yield tasks
    for task in tasks:
        task.cancel()


async def release_on(agent: Agent) -> None:
    while True:
        send_bool(agent, 1, False)
        await asyncio.sleep(0.02)


async def test_a_headset_cannot_release_what_an_operator_stopped(
    domain: int, peer: Peer, tmp_path: Path, flood: list[asyncio.Task[None]]
) -> None:
    """One headset sends false at 50 Hz, and has stopped the robot itself before: after `macs stop` nothing moves."""
    heard = await hear(peer)
    async with site(domain, tmp_path) as place, place.robot(), place.headset() as driver, place.headset(301) as bad:
        await may_command(driver, 1)
        async with driving(driver, 1):
            await until(lambda: heard.last == 0.5)
            send_bool(bad, 1, True)
            await until(lambda: heard.last == STOPPED)
            flood.append(asyncio.create_task(release_on(bad)))
            await until(lambda: heard.last == 0.5)  # what it stopped, it may release
            code, out, errors = await ended("stop", "1", "-e", place.router.endpoint)
            assert (code, out) == (0, "robot 1 is stopped, by operator/0\n"), errors
            count = len(heard.values)
            await asyncio.sleep(1.0)
            assert len(heard.values) == count
            assert heard.last == STOPPED
            code, out, errors = await ended("stop", "1", "--release", "-e", place.router.endpoint)
            assert code == 0, out + errors
            await until(lambda: heard.last == 0.5)


async def test_a_release_right_after_a_stop_is_told(
    domain: int, peer: Peer, tmp_path: Path, flood: list[asyncio.Task[None]]
) -> None:
    """Where settings let everybody release, and somebody does: `macs stop` names it and exits with 1."""
    async with site(domain, tmp_path, OPEN) as place, place.robot(), place.headset(301) as bad:
        await until(lambda: (1, 1) in bad.directory)
        flood.append(asyncio.create_task(release_on(bad)))
        code, out, _ = await ended("stop", "1", "-e", place.router.endpoint)
        assert (code, out) == (1, "robot 1 is NOT stopped: it stopped, and unity/301 released it\n")


async def test_whose_session_ended_cannot_take_back(domain: int, tmp_path: Path) -> None:
    """The stop of an agent that left stays, and the next one with its id does not release it; an operator does."""
    async with site(domain, tmp_path) as place, place.robot(), place.headset() as witness:
        async with place.headset(301) as first:
            await until(lambda: (1, 1) in first.directory)
            await first.call("ros", 1, "stop", b"true")
        await until(lambda: (2, 301) not in witness.directory)
        async with place.headset(301) as second:
            await until(lambda: (1, 1) in second.directory)
            with pytest.raises(Refused, match=r"unity/301 may not release what unity/301 \(left\) stopped"):
                await second.call("ros", 1, "stop", b"false")
            status = json.loads(await second.call("ros", 1, "status"))
            assert (status["stopped"], status["stop"]["pressed"]) == (True, ["unity/301 (left)"])
        code, _, _ = await ended("stop", "1", "--release", "-e", place.router.endpoint)
        assert code == 0


async def test_a_release_is_for_what_its_sender_has_seen(domain: int, tmp_path: Path) -> None:
    """Whoever says which presses he has seen releases those: one by somebody else that came since stays, and so does
    one that comes before the release is said again."""
    async with (
        site(domain, tmp_path) as place,
        place.robot(),
        place.headset(301) as other,
        place.operator(5) as operator,
    ):
        await until(lambda: all((1, 1) in agent.directory for agent in (operator, other)))
        seen = json.loads(await operator.call("ros", 1, "stop", b"true"))["stop"]["presses"]
        await other.call("ros", 1, "stop", b"true")
        for _ in range(2):
            with pytest.raises(Refused, match="again after this release was sent, by operator/5 and unity/301"):
                await operator.call("ros", 1, "stop", release(seen))
        seen = json.loads(await operator.call("ros", 1, "status"))["stop"]["presses"]
        assert json.loads(await operator.call("ros", 1, "stop", release(seen)))["stopped"] is False
        await other.call("ros", 1, "stop", b"true")
        with pytest.raises(Refused, match="by unity/301"):
            await operator.call("ros", 1, "stop", release(seen))  # a second time, late
        assert json.loads(await operator.call("ros", 1, "status"))["stopped"] is True
