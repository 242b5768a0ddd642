"""The shipped access rules (config/router-access.json5) on a real router, with passwords in place of certificates."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import macs_zenoh
from bridge.cli.robots import operator
from macs_zenoh import awareness
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import Unreachable
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import named
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.keyexpr import NAMED, PRESENCE, STREAM
from macs_zenoh.protocol.messages import OPERATOR, Metadata, NodeType, StreamData, encode_management
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams
from tests.support.programs import free_port
from tests.support.waiting import PATIENCE_S

RULES = Path(__file__).parents[2] / "config" / "router-access.json5"
USERS = ("robot-7", "gateway-1", "observer")


@pytest.fixture
async def as_user(tmp_path: Path) -> AsyncIterator[Callable[[str], MeshSettings]]:
    """A router with the rules; gives the settings with which a user connects to it."""
    rules = tmp_path / "rules.json5"
    rules.write_text(RULES.read_text().replace("cert_common_names", "usernames"))
    passwords = tmp_path / "passwords"
    passwords.write_text("".join(f"{user}:secret\n" for user in USERS))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = MeshSettings(
        mode="router",
        listen=[endpoint],
        config_file=str(rules),
        overrides=[f"transport/auth/usrpwd/dictionary_file:'{passwords}'", *credentials("observer")],
    )

    def settings(user: str) -> MeshSettings:
        return MeshSettings(connect=[endpoint], overrides=credentials(user))

    async with await Mesh.open(router):
        yield settings


def credentials(user: str) -> list[str]:
    return [f"transport/auth/usrpwd/user:'{user}'", "transport/auth/usrpwd/password:'secret'"]


async def online(agent: Any, agent_type: int, agent_id: int) -> None:
    """Wait until the agent sees the other one."""
    seen = asyncio.Event()
    agent.on_presence(lambda who, here: seen.set() if here and (who.type, who.id) == (agent_type, agent_id) else None)
    await asyncio.wait_for(seen.wait(), PATIENCE_S)


async def test_what_the_rules_allow_works(as_user: Callable[[str], MeshSettings]) -> None:
    """Robot 7 and a gateway's headset see each other, send by id, by group and to all, and call each other."""
    async with (
        macs_zenoh.join("ros", id=7, group=3, settings=as_user("robot-7")) as robot,
        macs_zenoh.join("unity", id=9, settings=as_user("gateway-1")) as headset,
    ):
        await online(robot, 2, 9)
        await online(headset, 1, 7)

        async def answer(call: macs_zenoh.Call) -> bytes:
            return b"yes, " + call.data

        robot.serve("ask", answer)
        headset.serve("ask", answer)
        robot.broadcast(b"serving")  # what a session declares arrives before what it sends afterwards
        headset.broadcast(b"serving")
        for agent in (robot, headset):
            assert (await asyncio.wait_for(agent.receive(), PATIENCE_S)).data == b"serving"
        assert await headset.call("ros", 7, "ask", b"headset") == b"yes, headset"
        assert await robot.call("unity", 9, "ask", b"robot") == b"yes, robot"

        headset.send(b"by id", to="ros", ids=[7])
        headset.send(b"by group", to="ros", groups=[3])
        headset.broadcast(b"to all")
        got = {(await asyncio.wait_for(robot.receive(), PATIENCE_S)).data for _ in range(3)}
        assert got == {b"by id", b"by group", b"to all"}

        robot.send(b"back", to="unity", ids=[9])
        assert (await asyncio.wait_for(headset.receive(), PATIENCE_S)).data == b"back"

        streamed: asyncio.Queue[bytes] = asyncio.Queue()

        def take(batch: Iterator[tuple[str, bytes]]) -> None:
            for _, payload in batch:
                streamed.put_nowait(payload)

        headset.mesh.subscribe(STREAM.every(type=1, id=7), take)
        await headset.call("ros", 7, "ask")  # by its answer the robot knows of the subscription
        Streams(robot).publish("nd__pose", b"topic data")
        assert await asyncio.wait_for(streamed.get(), PATIENCE_S) == b"topic data"


async def test_an_agent_uses_a_robot_within_the_rules(as_user: Callable[[str], MeshSettings]) -> None:
    """With the rights of a gateway's headset, an agent registers on a robot and receives its topic."""
    async with (
        macs_zenoh.join("ros", id=7, group=3, settings=as_user("robot-7")) as robot,
        macs_zenoh.join("unity", id=9, settings=as_user("gateway-1")) as agent,
    ):
        asked: list[str] = []

        async def add(call: macs_zenoh.Call) -> bytes:
            asked.append(f"{call.sender_type}/{call.sender_id}")
            return b""

        robot.serve("add_node", add)
        await online(agent, 1, 7)
        poses = await agent.subscribe("/pose", robot=7, type="std_msgs/String", timeout_s=PATIENCE_S)
        assert asked == ["unity/9"]
        metadata = Metadata(1, 7, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__pose", "std_msgs/String")
        management = encode_management(StreamData({"2": [9]}))
        frame = encode_frame(1, management=management, message=encode_message(metadata.encode(), b"topic data"))
        waiting = asyncio.create_task(poses.receive())
        while not waiting.done():
            Streams(robot).publish("nd__pose", frame)  # until it knows of the subscription
            await asyncio.sleep(0.05)
        assert waiting.result().data == b"topic data"


async def test_a_robot_cannot_speak_as_another(as_user: Callable[[str], MeshSettings]) -> None:
    """With robot 7's credentials, robot 8 is neither seen nor heard."""
    async with (
        macs_zenoh.join("unity", id=9, settings=as_user("gateway-1")) as headset,
        macs_zenoh.join("ros", id=7, settings=as_user("robot-7")) as robot,
        macs_zenoh.join("ros", id=8, settings=as_user("robot-7")) as thief,
    ):
        await online(headset, 1, 7)
        await online(thief, 2, 9)
        await online(robot, 2, 9)
        thief.send(b"I am robot 8", to="unity", ids=[9])
        with pytest.raises(Unreachable):
            await headset.call("ros", 8, "ask", timeout_s=1)
        robot.send(b"I am robot 7", to="unity", ids=[9])
        assert (await asyncio.wait_for(headset.receive(), PATIENCE_S)).data == b"I am robot 7"
        assert {agent.id for agent in headset.online() if agent.type == 1} == {7}


async def test_a_robot_has_its_own_name_only(as_user: Callable[[str], MeshSettings]) -> None:
    """Robot 7 is known as drone7, sends to itself under that name, and under another one is not heard.

    Neither is a gateway that sends as a robot, whatever the message type.
    """
    async with (
        macs_zenoh.join("ros", id=7, settings=as_user("robot-7")) as robot,
        awareness.join(robot, "drone7") as drone,
        await Mesh.open(as_user("gateway-1")) as gateway,
        await Mesh.open(as_user("robot-7")) as thief,
    ):
        received: asyncio.Queue[awareness.Received] = asyncio.Queue()
        for message_type in ("t", "unity"):
            drone.register(message_type, received.put_nowait)
        key = NAMED.of(name="drone7", message_type="t", from_name="drone7")
        payload = named.encode(named.Envelope("s", 1), b"as itself")
        while True:  # until the rules' router has passed on who serves
            try:
                await thief.query(key, payload, timeout_s=1)
                break
            except Unreachable:
                await asyncio.sleep(0.05)
        assert (await asyncio.wait_for(received.get(), PATIENCE_S)).data == b"as itself"
        for mesh, message_type, sender in ((thief, "t", "drone8"), (gateway, "t", "drone8"), (gateway, "unity", "9")):
            key = NAMED.of(name="drone7", message_type=message_type, from_name=sender)
            with pytest.raises(Unreachable):
                await mesh.query(key, named.encode(named.Envelope("s", 2), b"forged"), timeout_s=0.5)
        assert received.empty()


async def test_an_observer_sees_who_is_online(as_user: Callable[[str], MeshSettings]) -> None:
    """The observer gets the list of agents."""
    async with (
        macs_zenoh.join("ros", id=7, group=3, settings=as_user("robot-7")),
        await Mesh.open(as_user("observer")) as mesh,
    ):
        keys = await mesh.tokens(PRESENCE.every(), timeout_s=PATIENCE_S)
    assert [fields.id for key in keys if (fields := PRESENCE.parse(key))] == [7]


async def test_an_observer_asks_robots_and_stops_none(as_user: Callable[[str], MeshSettings]) -> None:
    """The observer hears a robot's state as operator/0; its stop does not arrive, under whichever name."""
    heard = []

    async def answer(call: macs_zenoh.Call) -> bytes:
        heard.append(call.verb)
        return b"{}"

    async with (
        macs_zenoh.join("ros", id=7, settings=as_user("robot-7")) as robot,
        operator(as_user("observer"), AgentId(OPERATOR, 0), timeout_s=PATIENCE_S) as nobody,
        operator(as_user("observer"), AgentId(OPERATOR, 5), timeout_s=PATIENCE_S) as somebody,
    ):
        for verb in ("status", "offers", "stop"):
            robot.serve(verb, answer)
        while not heard:  # until the router knows who serves
            with suppress(Unreachable):
                assert await nobody.ask(7, "status", timeout_s=PATIENCE_S) == b"{}"
        assert await nobody.ask(7, "offers", timeout_s=PATIENCE_S) == b"{}"
        for asker, verb in ((nobody, "stop"), (somebody, "stop"), (somebody, "status")):
            with pytest.raises(Unreachable):
                await asker.ask(7, verb, timeout_s=0.5)
        assert heard == ["status", "offers"]
