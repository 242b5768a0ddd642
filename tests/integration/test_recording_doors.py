"""A recording says by which token a headset came, as its gateway knows it."""

from __future__ import annotations

import asyncio
import json
import os
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

import macs_zenoh
from bridge.headset.client import Headset
from bridge.recording.bag import Bag
from bridge.recording.conditions import Event
from bridge.recording.disk import Entry
from bridge.recording.doors import Doors
from bridge.recording.schema_source import Schemas
from bridge.recording.sent import SentCommands
from bridge.recording.streams import TOKENS
from bridge.recording.traffic import Sent
from bridge.tokens import store
from macs_zenoh.agent import Agent
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.support.programs import Program, free_port
from tests.support.routers import Router
from tests.support.waiting import until


async def test_the_token_of_a_headset_is_recorded(tmp_path: Path) -> None:
    """One that came before the recording and one that comes while it goes on: name and address of both."""
    tokens, file = tmp_path / "tokens.json", tmp_path / "a.mcap"
    secrets = {name: new_secret(os.urandom(32)) for name in ("anna", "ben")}
    for name, secret in secrets.items():
        token = Token(name=name, rights=Rights(may=["see"]), hashes=[hash_of(secret)])
        store.change(tokens, lambda known, token=token: (known.with_token(token), None))
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()

    async with AsyncExitStack() as stack:
        for words in (
            ("router", "-l", endpoint),
            ("gateway", "--port", str(port), "--tokens", str(tokens), "-e", endpoint),
        ):
            await stack.enter_async_context(Program(*words))
        for name, secret in secrets.items():
            headset = await Headset.connect("127.0.0.1", port, token=secret)
            stack.push_async_callback(headset.close)
            if name == "anna":
                recording = ("record", "--compress", "none", "-o", str(file), "-e", endpoint)
                await stack.enter_async_context(Program(*recording))
        await until(lambda: b'"token":"anna"' in (read := file.read_bytes()) and b'"token":"ben"' in read, every_s=0.1)
    with Bag(file) as bag:
        told = [json.loads(message.data) for message in bag.messages(lambda channel: channel.topic == TOKENS)]
    assert {each["token"]: each["address"].rpartition(":")[0] for each in told} == dict.fromkeys(secrets, "127.0.0.1")
    assert all(each["agent"].startswith("unity/") for each in told)


async def test_a_program_tells_of_its_own_agents_alone() -> None:
    """One that answers with another's agent, or with one that is not online, is not believed in that; nor is an
    answer about an id that somebody else has had since the question."""
    events: list[Event] = []
    loop = asyncio.get_running_loop()
    async with (
        Router() as router,
        macs_zenoh.join("operator", connect=[router.endpoint]) as recorder,
        macs_zenoh.join("unity", connect=[router.endpoint]) as rogue,
        macs_zenoh.join("unity", connect=[router.endpoint]) as honest,
    ):
        await until(lambda: rogue.key in recorder.directory and honest.key in recorder.directory)
        doors = Doors(recorder, events.append)
        answers = ["old", "new"]

        def by_rogue() -> bytes:
            return of({rogue.id: "its own", honest.id: "stolen", 9999: "nobody"})

        def by_honest() -> bytes:
            token = answers.pop(0) if answers else "new"
            if token == "old":  # whoever has the id now has come after the question
                loop.call_soon_threadsafe(doors.came, there(recorder, honest))
            return of({honest.id: token})

        rogue.mesh.told, honest.mesh.told = by_rogue, by_honest
        for agent in (honest, rogue):
            doors.came(there(recorder, agent))
        await until(lambda: len(events) >= 2 and not doors._asking)
        doors.came(there(recorder, rogue))
        await until(lambda: not doors._asking)
        assert await doors.token(str(honest.key)) == "new"
        doors.close()
    told = {(event.value["agent"], event.value["token"], event.value["gateway"]) for event in events}
    assert told == {
        (str(rogue.key), "its own", rogue.mesh.zid),
        (str(honest.key), "new", honest.mesh.zid),
    }


def of(tokens: dict[int, str]) -> bytes:
    """What a gateway answers that has these headsets."""
    return ping.encode_told([ping.GatewayAgent(2, number, "10.0.0.1:1", name) for number, name in tokens.items()], {})


def there(seen_by: Agent, agent: Agent) -> AgentInfo:
    """An agent as the directory has it."""
    found = seen_by.directory.get(agent.key.type, agent.id)
    assert found is not None
    return found


class Kept:
    """A sink that keeps all of it."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []

    def put(self, entry: Entry) -> None:
        self.entries.append(entry)


async def test_commands_have_it_beside_them() -> None:
    """The channel of what a headset sent names its token; of one that is not known nothing."""
    kept = Kept()

    async def token(sender: str) -> str:
        return "anna" if sender == "unity/256" else ""

    commands = SentCommands(kept, Schemas(None), {}, token)  # type: ignore[arg-type]
    for sender in ("unity/256", "unity/257"):
        commands.put(Sent(sender, "7", "nd__cmd_vel", "geometry_msgs/Twist", bytes(52)), 1)
    await until(lambda: len(kept.entries) == 2)
    assert [entry.channel.metadata.get("token") for entry in kept.entries] == ["anna", None]
