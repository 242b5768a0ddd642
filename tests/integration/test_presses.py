"""An emergency stop that is sent as data: its gateway asks the robot for it as well, in the headset's name, and an
agent does so for itself."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress

import pytest

import macs_zenoh
from bridge.gateway import Gateway
from bridge.headset.client import Headset
from macs_zenoh import presses
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError
from macs_zenoh.mesh import Traffic
from macs_zenoh.protocol import routing
from macs_zenoh.protocol.messages import Metadata, NodeType
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.serving import Call
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.waiting import PATIENCE_S, until

STOP = Metadata(node_type=NodeType.PUBLISHER, node_name="nd__emergency_stop", data_exchange_type="std_msgs/Bool")
PRESS, RELEASE = b"\x00\x01\x00\x00\x01", b"\x00\x01\x00\x00\x00"


async def can_be_asked(gateway: Gateway, *robots: int) -> None:
    """Until the gateway's session has heard that these robots are online and answer: of their presence it hears first,
    and what is asked for in between reaches nobody."""

    async def has_answered(robot: int) -> bool:
        key, frame = routing.call((1, robot), "there", (2, 0), b"", Metadata(2, 0))
        with suppress(MacsError):
            await gateway.mesh.query(key, frame, timeout_s=1.0, traffic=Traffic.CALL)
            return True
        return False

    for robot in robots:
        await until(lambda robot=robot: (1, robot) in gateway.directory)  # type: ignore[misc]
        await until(lambda robot=robot: has_answered(robot))  # type: ignore[misc]


async def _there(_: Call) -> bytes:
    return b"yes"


class Asked:
    """A robot that notes who asks it for what."""

    def __init__(self, agent: Agent) -> None:
        self.calls: list[Call] = []
        agent.serve("stop", self._stop)
        agent.serve("there", _there)

    async def _stop(self, call: Call) -> bytes:
        self.calls.append(call)
        return b""


def said(
    data: bytes, to: int = 1, ids: tuple[int, ...] = (), groups: tuple[int, ...] = (), about: Metadata = STOP
) -> bytes:
    """What a headset sends."""
    return encode_frame(to, ids, groups, message=encode_message(about.encode(), data))


@pytest.mark.parametrize(
    "frame", [said(PRESS, ids=(7,)), said(PRESS, groups=(3,)), said(PRESS, to=0)], ids=["id", "group", "all"]
)
async def test_a_press_is_asked_for_as_well(
    router: str, start_gateway: StartGateway, connect: Connect, frame: bytes
) -> None:
    """To robots by id, by group or to all: each is asked for the stop, by the headset; the data goes to it too."""
    gateway = await start_gateway()
    async with macs_zenoh.join("ros", id=7, group=3, settings=patient(router)) as robot:
        asked = Asked(robot)
        headset = await connect(gateway)
        await can_be_asked(gateway, 7)

        heard: list[bytes] = []
        robot.on_message(lambda message: heard.append(message.data))

        async def is_asked() -> bool:
            await headset.send_frame(frame)
            return bool(asked.calls and heard)

        await until(is_asked, every_s=presses.AGAIN_S)  # what waits too long on a busy machine is let go of
        call = asked.calls[0]
        assert (call.sender_type, call.sender_id, call.data) == ("unity", headset.id, b"true")
        assert call.metadata.node_name == STOP.node_name
        assert set(heard) == {PRESS}


async def test_nothing_else_is_asked_for(router: str, start_gateway: StartGateway, connect: Connect) -> None:
    """A release, another Bool and a message to a headset ask no robot for a stop; a press after them does, once."""
    gateway = await start_gateway()
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as robot:
        asked = Asked(robot)
        headset = await connect(gateway)
        await can_be_asked(gateway, 7)
        lamp = Metadata(node_type=NodeType.PUBLISHER, node_name="nd__lamp", data_exchange_type="std_msgs/Bool")
        for frame in (said(RELEASE, ids=(7,)), said(PRESS, ids=(7,), about=lamp), said(PRESS, to=2, ids=(7,))):
            await headset.send_frame(frame)
        await headset.send_frame(said(b"", ids=(7,)))
        for expected in (RELEASE, PRESS, b""):
            assert (await asyncio.wait_for(robot.receive(), PATIENCE_S)).data == expected
        await headset.send_frame(said(PRESS, ids=(7,)))
        assert (await asyncio.wait_for(robot.receive(), PATIENCE_S)).data == PRESS
        await until(lambda: asked.calls)
        await asyncio.sleep(0.2)
        assert len(asked.calls) == 1


# -- a release and its stop ------------------------------------------------------------------------------------------


class Slow:
    """A robot that answers a question for its stop only when it is let, and notes all that comes, in order."""

    def __init__(self, agent: Agent) -> None:
        self.answer = asyncio.Event()
        self.came: list[bytes] = []
        agent.serve("stop", self._stop)
        agent.serve("there", _there)
        agent.on_message(lambda message: self.came.append(message.data))

    async def _stop(self, call: Call) -> bytes:
        self.came.append(b"asked " + call.data)
        await self.answer.wait()
        return b""


Site = tuple[Gateway, Slow, Headset]


@pytest.fixture
async def site(router: str, start_gateway: StartGateway, connect: Connect) -> AsyncIterator[Site]:
    """A gateway, such a robot, which can be asked, and a headset."""
    gateway = await start_gateway()
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as agent:
        robot = Slow(agent)
        headset = await connect(gateway)
        await can_be_asked(gateway, 7)
        yield gateway, robot, headset


async def test_a_release_does_not_overtake_the_question_for_its_stop(site: Site) -> None:
    """It waits until the robot has answered, and then it comes; what else the headset sends does not wait for it."""
    _, robot, headset = site
    await headset.send_frame(said(PRESS, ids=(7,)))
    await until(lambda: {PRESS, b"asked true"} <= set(robot.came))  # in one go with its release it is not asked for
    await headset.send_frame(said(RELEASE, ids=(7,)))
    await headset.send_frame(said(b"else", ids=(7,), about=Metadata()))
    await until(lambda: b"else" in robot.came)
    assert RELEASE not in robot.came
    robot.answer.set()
    await until(lambda: RELEASE in robot.came)
    assert robot.came.count(RELEASE) == 1


async def test_a_press_takes_the_place_of_a_release_that_waits(site: Site) -> None:
    """Who has released and stops again wants it stopped: the release is not sent any more, and that is counted."""
    gateway, robot, headset = site
    await headset.send_frame(said(PRESS, ids=(7,)))
    await until(lambda: b"asked true" in robot.came)
    await headset.send_frame(said(RELEASE, ids=(7,)))
    await headset.send_frame(said(b"else", ids=(7,), about=Metadata()))
    await until(lambda: b"else" in robot.came)
    await headset.send_frame(said(PRESS, ids=(7,)))
    await until(lambda: robot.came.count(PRESS) == 2)
    robot.answer.set()
    await asyncio.sleep(2 * presses.SETTLED_S)
    await headset.send_frame(said(b"last", ids=(7,), about=Metadata()))
    await until(lambda: b"last" in robot.came)
    assert RELEASE not in robot.came
    (connection,) = gateway.agents.online()
    assert connection.drops["too_old"] == 1


async def test_what_a_headset_released_counts_when_it_has_left(site: Site) -> None:
    """Its release does not wait any longer than the headset is there."""
    _, robot, headset = site
    await headset.send_frame(said(PRESS, ids=(7,)))
    await until(lambda: {PRESS, b"asked true"} <= set(robot.came))
    await headset.send_frame(said(RELEASE, ids=(7,)))
    await headset.close()
    await until(lambda: RELEASE in robot.came)
    robot.answer.set()


async def test_a_question_that_is_lost_keeps_no_other_from_being_asked(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who presses again is asked for again, though the first question has no answer yet; not for every press."""
    monkeypatch.setattr(presses, "ANSWER_S", 60.0)
    _, robot, headset = site
    await headset.send_frame(said(PRESS, ids=(7,)) * 20)
    await until(lambda: b"asked true" in robot.came)
    await asyncio.sleep(presses.AGAIN_S)
    await headset.send_frame(said(PRESS, ids=(7,)))
    await until(lambda: robot.came.count(b"asked true") == 2)
    robot.answer.set()


async def test_an_agent_asks_for_its_own_stop(router: str) -> None:
    """What a program on the mesh sends on the topic of the stop is asked for as well, and its release waits."""
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as agent:
        robot = Slow(agent)
        async with macs_zenoh.join("unity", id=300, settings=patient(router)) as presser:
            await until(lambda: (1, 7) in presser.directory)
            for data in (PRESS, RELEASE):
                presser.send(data, to="ros", ids=[7], metadata=STOP)
            await until(lambda: {PRESS, b"asked true"} <= set(robot.came))
            assert RELEASE not in robot.came
            robot.answer.set()
            await until(lambda: RELEASE in robot.came)


async def test_a_press_drops_releases_of_the_same_robots_only(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """A release for one robot waits for the question to it, and is not lost when the other one is stopped."""
    gateway = await start_gateway()
    async with (
        macs_zenoh.join("ros", id=7, settings=patient(router)) as seven,
        macs_zenoh.join("ros", id=8, settings=patient(router)) as eight,
    ):
        robots = Slow(seven), Slow(eight)
        headset = await connect(gateway)
        await can_be_asked(gateway, 7, 8)
        await headset.send_frame(said(PRESS, ids=(7,)))
        await until(lambda: b"asked true" in robots[0].came)
        await headset.send_frame(said(RELEASE, ids=(7,)) + said(PRESS, ids=(8,)))
        await until(lambda: b"asked true" in robots[1].came)
        for robot in robots:
            robot.answer.set()
        await until(lambda: RELEASE in robots[0].came)
        assert RELEASE not in robots[1].came


async def test_what_an_agent_released_is_sent_before_it_leaves(router: str) -> None:
    """The last thing that a program says is not lost."""
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as agent:
        robot = Slow(agent)
        async with macs_zenoh.join("unity", id=300, settings=patient(router)) as presser:
            await until(lambda: (1, 7) in presser.directory)
            for data in (PRESS, RELEASE):
                presser.send(data, to="ros", ids=[7], metadata=STOP)
            await until(lambda: b"asked true" in robot.came)
        await until(lambda: RELEASE in robot.came)
        robot.answer.set()
