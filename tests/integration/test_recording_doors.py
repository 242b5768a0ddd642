"""A recording says by which token a headset came, as its gateway knows it."""

from __future__ import annotations

import json
import os
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

from bridge.headset.client import Headset
from bridge.recording.bag import Bag
from bridge.recording.disk import Entry
from bridge.recording.schema_source import Schemas
from bridge.recording.sent import SentCommands
from bridge.recording.streams import TOKENS
from bridge.recording.traffic import Sent
from bridge.tokens import store
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.support.programs import Program, free_port
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
