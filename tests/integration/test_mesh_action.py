"""Goals that an agent on the mesh gives to a robot which loses results, or leaves."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack

import pytest

import macs_zenoh
from bridge.graph.acts import MeshAction
from bridge.headset import actions
from bridge.headset.actions import SUCCEEDED, Goal
from macs_zenoh.agent import Agent
from macs_zenoh.protocol.messages import ActionVerb, Metadata, NodeType
from macs_zenoh.protocol.reading import Message
from tests.support.local import patient
from tests.support.waiting import PATIENCE_S, until

TURN = "demo_msgs/Turn"


class Forgetful:
    """Robot 7: it accepts goals, and tells a result when it is asked for it, not when there is one."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.asked: list[str] = []
        self.finished = False
        agent.serve("add_node", self._take)
        agent.serve("remove_node", self._take)
        agent.on_message(self._hear)

    async def _take(self, call: macs_zenoh.Call) -> bytes:
        return b""

    def _hear(self, message: Message) -> None:
        said, goal = message.metadata, message.data[:16]
        self.asked.append(said.message_manager)
        if said.message_manager == ActionVerb.GOAL:
            self._tell(message, ActionVerb.ACCEPTED, goal + b"\1")
        elif said.message_manager == ActionVerb.RESULT and self.finished:
            self._tell(message, ActionVerb.RESULT, goal + bytes([SUCCEEDED]) + b"turned")

    def _tell(self, message: Message, verb: ActionVerb, data: bytes) -> None:
        said = message.metadata
        metadata = Metadata(1, 7, said.request_id, verb.value, NodeType.ACTION, said.node_name, TURN)
        self.agent.reply(message, data, metadata=metadata)


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actions, "LOOK_S", 0.02)


@contextlib.asynccontextmanager
async def given(router: str) -> AsyncIterator[tuple[MeshAction, Goal]]:
    """A goal that robot 7 has accepted."""
    async with macs_zenoh.join("unity", id=300, settings=patient(router)) as agent:
        await until(lambda: agent.directory.ids(1) == [7], PATIENCE_S)
        client = MeshAction(agent, "/turn", TURN)
        await agent.use_action("/turn", robot=7, type=TURN, timeout_s=PATIENCE_S)
        with agent.on_message(client.take):
            yield client, await client.send_goal(7, b"\0\1\0\0", timeout_s=PATIENCE_S)


async def test_a_result_that_is_lost_is_asked_for(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Again and again, until it is there."""
    monkeypatch.setattr(actions, "ASK_S", 0.1)
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as agent:
        robot = Forgetful(agent)
        async with given(router) as (client, goal):
            following = asyncio.create_task(goal.follow(client.is_there))
            await until(lambda: robot.asked.count(ActionVerb.RESULT) >= 2, PATIENCE_S)
            assert not goal.finished.done()
            robot.finished = True
            assert await goal.result(PATIENCE_S) == (SUCCEEDED, b"turned")
            await asyncio.wait_for(following, PATIENCE_S)


async def test_a_robot_that_leaves_ends_the_wait(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who waits for the result, or for feedback, hears that it has left."""
    monkeypatch.setattr(actions, "LOST_S", 0.1)
    async with AsyncExitStack() as there:
        Forgetful(await there.enter_async_context(macs_zenoh.join("ros", id=7, settings=patient(router))))
        async with given(router) as (client, goal):
            following = asyncio.create_task(goal.follow(client.is_there))
            await there.aclose()
            assert [step async for step in goal] == []
            with pytest.raises(macs_zenoh.Unreachable, match=r"robot 7 .*it has left"):
                await goal.result(PATIENCE_S)
            await asyncio.wait_for(following, PATIENCE_S)


async def test_a_robot_that_comes_back_is_asked(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after a router that started again: the result may have come meanwhile."""
    monkeypatch.setattr(actions, "ASK_S", 0.1)
    monkeypatch.setattr(actions, "LOST_S", 10 * PATIENCE_S)
    async with AsyncExitStack() as there:
        Forgetful(await there.enter_async_context(macs_zenoh.join("ros", id=7, settings=patient(router))))
        async with given(router) as (client, goal):
            following = asyncio.create_task(goal.follow(client.is_there))
            await there.aclose()
            await until(lambda: client._agent.directory.ids(1) == [], PATIENCE_S)
            async with macs_zenoh.join("ros", id=7, settings=patient(router)) as again:
                robot = Forgetful(again)
                robot.finished = True
                assert await goal.result(PATIENCE_S) == (SUCCEEDED, b"turned")
                assert set(robot.asked) == {ActionVerb.RESULT}
            await asyncio.wait_for(following, PATIENCE_S)
