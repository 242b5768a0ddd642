"""What attackers say arrives by each way: else nothing would be shown by what it does not cost."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from bridge.headset.client import Headset
from tests.attack.raw import Agent, frame, metadata
from tests.attack.site import certified
from tests.attack.ways import WAYS, Way
from tests.support.programs import Program, free_port
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S


@pytest.mark.parametrize("way", WAYS)
async def test_an_attacker_comes_in_and_is_heard(way: Way, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets an id, a megabyte of its messages arrives whole and in order, and it ends without a word."""
    ports = {each: free_port() for each in WAYS}
    listening = ["--port", str(ports["tcp"])]
    if way != "tcp":
        listening += [f"--{way}-port", str(ports[way])]
    if way == "tls":
        listening += certified(tmp_path)
    monkeypatch.setattr(Agent, "way", way)
    async with (
        Router() as router,
        Program("gateway", *listening, "-e", router.endpoint),
        await Headset.connect("127.0.0.1", ports["tcp"]) as listener,
    ):
        attacker = await asyncio.to_thread(Agent, ports[way])
        said = metadata(message_manager="Hello")
        said_all = b"".join(
            frame(metadata=said, data=b"%d" % number + bytes(10_000), to=2, ids=[listener.id]) for number in range(100)
        )
        assert await asyncio.to_thread(attacker.send, said_all)
        for number in range(100):
            message = await asyncio.wait_for(listener.receive(), PATIENCE_S)
            assert message.sender_id == attacker.id
            assert bytes(message.data).rstrip(b"\0") == b"%d" % number
        attacker.close(reset=True)
        while attacker.id in (await listener.online()).unity_agent_ids:
            await asyncio.sleep(0.02)
