"""Robots asked for several agents in one query: each is judged alone, and who does not take that is asked singly."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import macs_zenoh
from macs_zenoh import registration_calls, serving
from macs_zenoh.errors import HeldByAnother, Refused
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.protocol.directory import AgentInfo, Change, Directory
from macs_zenoh.protocol.keyexpr import CALL, CALLS
from macs_zenoh.protocol.messages import ROS, UNITY, AddNode, NodeRefused, NodeType, RemoveNode, decode_data
from macs_zenoh.protocol.registrations import Task, check_own
from macs_zenoh.protocol.wire import Layout
from macs_zenoh.registration_calls import RobotCalls
from tests.support.local import patient
from tests.support.waiting import until

ROBOT = 7
HEADSETS = range(256, 296)
MANY = CALLS.of(type=ROS, id=ROBOT, verb="add_node", from_type=UNITY, from_block=1)


@pytest.fixture(autouse=True)
def _unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine too what is wanted at once is asked for, and answered, at once."""
    monkeypatch.setattr(registration_calls, "TURN_S", 60.0)
    monkeypatch.setattr(serving, "TOGETHER_S", 60.0)


def node(headset: int, name: str = "x") -> AddNode:
    """A registration."""
    return AddNode(UNITY, headset, NodeType.SUBSCRIBER, f"nd__{name}", f"/{name}", "std_msgs/String")


def removal(headset: int, name: str = "x") -> RemoveNode:
    """What takes it back."""
    return RemoveNode(UNITY, headset, NodeType.SUBSCRIBER, f"nd__{name}")


class Asking:
    """What a gateway asks of robots, by key, and what its agents hear."""

    def __init__(self, mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
        self._mesh = mesh
        self.keys: list[str] = []
        self.refused: dict[int, str] = {}
        self.done: list[tuple[str, int]] = []
        ask = mesh.ask

        def asks(key: str, *args: Any, **how: Any) -> None:
            self.keys.append(key)
            ask(key, *args, **how)

        monkeypatch.setattr(mesh, "ask", asks)
        self.calls = RobotCalls(
            mesh,
            Directory(),
            Layout(),
            on_streams=lambda changes: None,
            on_refused=self._refused,
            on_done=lambda task: self.done.append((type(task.node).__name__, task.node.registrant_agent_id)),
            together=True,
        )
        self.came()

    def _refused(self, agent: tuple[int, int], refused: NodeRefused) -> None:
        self.refused[agent[1]] = refused.reason

    def came(self, session: str = "a") -> None:
        """The robot is online, or another one in its place."""
        robot = AgentInfo(ROS, ROBOT, 0, session)
        self.calls.presence(Change(robot, online=False))
        self.calls.presence(Change(robot, online=True))

    def register(self, *headsets: int, name: str = "x") -> None:
        """In one round of the loop."""
        for headset in headsets:
            self.calls.register(node(headset, name), [ROBOT], [])

    async def until_it_is_known(self) -> None:
        """Whether the robot takes several at once: asked when there are several."""
        await until(lambda: _answers(self._mesh, MANY))
        self.register(256, 257, 258, name="first")
        await until(lambda: len(self.done) == 3)
        await until(lambda: all(again != float("inf") for again in self._known().values()) and self._known())
        await until(lambda: not self.calls._goes_on)  # else the next one waits for the end of this round
        self.keys.clear()
        self.done.clear()

    def _known(self) -> dict[str, float]:
        assert self.calls._together is not None
        return self.calls._together._robots._robots.get(ROBOT, {})

    @property
    def together(self) -> int:
        """How many queries were for several agents."""
        return sum(CALLS.parse(key) is not None for key in self.keys)

    @property
    def alone(self) -> int:
        """How many were for one."""
        return sum(CALL.parse(key) is not None for key in self.keys)


@contextmanager
def asking(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> Iterator[Asking]:
    """A gateway's calls, until they are closed."""
    found = Asking(mesh, monkeypatch)
    yield found
    found.calls.close()


async def test_many_are_asked_for_in_few_queries(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What many want in one round goes in one query behind the first, and each of them has an answer of its own: done,
    refused, or held by another."""
    heard: list[tuple[str, int, int]] = []

    async def add(call: macs_zenoh.Call) -> bytes:
        request = decode_data(AddNode, call.data)
        check_own(request, (UNITY, call.sender_id))
        assert call.metadata.sender_agent_id == call.sender_id
        heard.append((call.sender_type, call.sender_id, request.registrant_agent_id))
        if call.sender_id == 260:
            raise Refused("not you")
        if call.sender_id == 261:
            raise HeldByAnother("taken", (UNITY, 300))
        return b""

    async with (
        macs_zenoh.join("ros", id=ROBOT, settings=patient(router)) as robot,
        await Mesh.open(patient(router)) as mesh,
    ):
        robot.serve("add_node", add)
        with asking(mesh, monkeypatch) as gateway:
            await gateway.until_it_is_known()
            heard.clear()
            gateway.register(*HEADSETS)
            assert gateway.keys == [CALL.of(type=ROS, id=ROBOT, verb="add_node", from_type=UNITY, from_id=256)]
            await until(lambda: len(heard) == len(HEADSETS) and len(gateway.done) == len(HEADSETS) - 2)
            assert [key for key in gateway.keys if "block" in key] == gateway.keys[1:2] == gateway.keys[1:]
            await until(lambda: len(gateway.refused) == 2)
            assert gateway.refused.keys() == {260, 261}
            assert "not you" in gateway.refused[260]
            assert heard == [("unity", headset, headset) for headset in HEADSETS]
            gateway.calls.presence(Change(AgentInfo(UNITY, 300, 0, "h"), online=False))
            await until(lambda: heard.count(("unity", 261, 261)) == 2)  # who held it has left
            await asyncio.sleep(0)
        assert robot.drops.total() == 0


async def test_blocks_go_apart(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A query speaks for the agents of one block, as routers allow it."""
    heard: list[int] = []

    async def add(call: macs_zenoh.Call) -> bytes:
        heard.append(call.sender_id)
        return b""

    async with (
        macs_zenoh.join("ros", id=ROBOT, settings=patient(router)) as robot,
        await Mesh.open(patient(router)) as mesh,
    ):
        robot.serve("add_node", add)
        with asking(mesh, monkeypatch) as gateway:
            await until(lambda: _answers(mesh, MANY))
            some = [number for block in (1, 2, 3) for number in range(block * 256, block * 256 + 5)]
            for name in "abcdefgh":
                gateway.register(*some, name=name)
                await until(lambda: len(heard) % len(some) == 0 and len(gateway.done) == len(heard))
                await until(lambda: float("inf") not in gateway._known().values())
            gateway.keys.clear()
            gateway.register(*some)
            await until(lambda: len(gateway.done) == len(heard) == 9 * len(some))
            blocks = [fields.from_block for key in gateway.keys if (fields := CALLS.parse(key)) is not None]
            assert sorted(blocks) == [1, 2, 3]


async def test_who_does_not_take_several_is_asked_for_each(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that serves single calls only: each registration goes by itself, none is lost, and it is not asked again
    until it comes anew."""
    heard: list[str] = []

    async def answer(key: str, payload: bytes) -> bytes:
        heard.append(key)
        return b""

    async def refuse(key: str, payload: bytes) -> bytes:
        raise Refused("what is that?")

    async with await Mesh.open(patient(router)) as robot, await Mesh.open(patient(router)) as mesh:
        robot.serve(CALL.every(type=ROS, id=ROBOT), answer)
        refusing = robot.serve(CALLS.every(type=ROS, id=ROBOT), refuse)
        await until(lambda: _is_served(mesh, MANY))
        with asking(mesh, monkeypatch) as gateway:
            gateway.register(*HEADSETS)
            await until(lambda: len(gateway.done) == len(HEADSETS))
            await until(lambda: gateway.together == 1 and float("inf") in gateway._known().values())
            gateway.register(*HEADSETS, name="y")
            await until(lambda: len(gateway.done) == 2 * len(HEADSETS))
            assert (gateway.together, gateway.alone, len(heard)) == (1, 2 * len(HEADSETS), 2 * len(HEADSETS))
            refusing.close()
            gateway.came("b")
            await until(lambda: len(gateway.done) == 4 * len(HEADSETS))
            await until(lambda: gateway.together == 2)
            assert gateway.refused == {}


async def test_a_query_that_is_lost_loses_no_registration(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that answers that it takes several, and then nothing, or something else: each is asked for by itself."""
    heard: list[str] = []

    async def answer(key: str, payload: bytes) -> bytes:
        heard.append(key)
        return b""

    async def boast(key: str, payload: bytes) -> bytes | None:
        return b"[]" if not payload else b"[null]" if len(heard) % 2 else None

    async with await Mesh.open(patient(router)) as robot, await Mesh.open(patient(router)) as mesh:
        robot.serve(CALL.every(type=ROS, id=ROBOT), answer)
        robot.serve(CALLS.every(type=ROS, id=ROBOT), boast)
        with asking(mesh, monkeypatch) as gateway:
            await gateway.until_it_is_known()
            heard.clear()
            gateway.register(*HEADSETS)
            await until(lambda: len(gateway.done) == len(HEADSETS))
            assert gateway.together == 1
            assert {CALL.parse(key).from_id for key in heard} == set(HEADSETS)  # type: ignore[union-attr]
            assert gateway.refused == {}


async def test_one_that_takes_long_holds_up_no_other(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others have their answers, and it has its own when it is done."""
    monkeypatch.setattr(serving, "TOGETHER_S", 0.01)
    go_on = asyncio.Event()
    heard: list[int] = []

    async def add(call: macs_zenoh.Call) -> bytes:
        heard.append(call.sender_id)
        if call.sender_id == 270:
            await go_on.wait()
        return b""

    async with (
        macs_zenoh.join("ros", id=ROBOT, settings=patient(router)) as robot,
        await Mesh.open(patient(router)) as mesh,
    ):
        robot.serve("add_node", add)
        with asking(mesh, monkeypatch) as gateway:
            await gateway.until_it_is_known()
            gateway.register(*HEADSETS)
            await until(lambda: len(gateway.done) == len(HEADSETS) - 1)
            await until(lambda: heard.count(270) > 1)
            go_on.set()
            await until(lambda: ("AddNode", 270) in gateway.done)
            assert gateway.refused == {}


async def test_what_is_taken_back_at_once_stays_so(router: str) -> None:
    """Where calls for several and a call behind them come in one moment, the robot begins with those."""
    began: list[str] = []

    async def note(call: macs_zenoh.Call) -> bytes:
        began.append(call.verb)
        return b""

    async with (
        macs_zenoh.join("ros", id=ROBOT, settings=patient(router)) as robot,
        await Mesh.open(patient(router)) as mesh,
    ):
        robot.serve("add_node", note)
        robot.serve("remove_node", note)
        calls = RobotCalls(
            mesh, Directory(), Layout(), on_streams=lambda changes: None, on_refused=lambda *_: None, together=True
        )
        await until(lambda: _answers(mesh, MANY))
        adding, removing = node(256), removal(256)
        one, frame = calls._question(_task(removing), calls._telling(removing))
        _, added = calls._question(_task(adding), calls._telling(adding))
        for _ in range(20):
            began.clear()
            told: list[object] = []
            mesh.ask(MANY, added * 3, told.append, of=1, timeout_s=30, traffic=Traffic.REGISTRATION)
            mesh.ask(one, frame, told.append, of=1, timeout_s=30, traffic=Traffic.REGISTRATION)
            time.sleep(0.02)  # both are there when the loop looks
            await until(lambda told=told: len(told) == 2)
            assert began == ["add_node"] * 3 + ["remove_node"]
        calls.close()


async def test_nobody_is_registered_for_another_block(router: str) -> None:
    """Whom the key does not name, for him nothing is done, nor for those beside him."""
    heard: list[int] = []

    async def add(call: macs_zenoh.Call) -> bytes:
        heard.append(call.sender_id)
        return b""

    async with (
        macs_zenoh.join("ros", id=ROBOT, settings=patient(router)) as robot,
        await Mesh.open(patient(router)) as mesh,
    ):
        robot.serve("add_node", add)
        calls = RobotCalls(mesh, Directory(), Layout(), on_streams=lambda _: None, on_refused=lambda *_: None)
        await until(lambda: _answers(mesh, MANY))
        frames = [calls._question(_task(node(who)), calls._telling(node(who)))[1] for who in (256, 512)]
        with pytest.raises(Refused):
            await mesh.query(MANY, b"".join(frames), timeout_s=30)
        assert heard == []
        assert await mesh.query(MANY, frames[0], timeout_s=30) == b"[null]"
        assert heard == [256]
        calls.close()


def _task(node: AddNode | RemoveNode) -> Any:
    return Task(ROBOT, node)


async def _answers(mesh: Mesh, key: str) -> bool:
    try:
        return await mesh.query(key, b"", timeout_s=30) == b"[]"
    except macs_zenoh.MacsError:
        return False


async def _is_served(mesh: Mesh, key: str) -> bool:
    try:
        await mesh.query(key, b"", timeout_s=30)
    except Refused:
        return True
    except macs_zenoh.MacsError:
        return False
    return True
