"""What the audit record says of orders to a recorder, and how an order that is not carried out is answered."""

from __future__ import annotations

import json
import os
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason="needs the extra web: pip install 'macs-zenoh[web]'")

import aiohttp
from aiohttp import web

from bridge.page import recordings
from bridge.page.recordings import MISSING
from bridge.recording.serving import socket_of
from bridge.tokens import store
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.support.programs import Program, free_port
from tests.support.waiting import until


@dataclass
class Port:
    """A gateway's web port whose recorder is what a test puts there."""

    folder: Path
    audit: Path
    url: str
    secrets: dict[str, str]

    async def post(self, what: str, token: str = "desk") -> tuple[int, Any]:
        headers = {"Authorization": f"Bearer {self.secrets[token]}"}
        async with (
            aiohttp.ClientSession(headers=headers) as session,
            session.post(f"{self.url}/recordings/{what}") as answer,
        ):
            return answer.status, await answer.json()

    def notes(self) -> list[tuple[str, str, str]]:
        """Token, order and result of each note of an order."""
        lines = [json.loads(line) for line in self.audit.read_text().splitlines()]
        return [(line["by"]["token"], line["what"], line["result"]) for line in lines if line["event"] == "recording"]


@pytest.fixture
async def port(tmp_path: Path) -> AsyncIterator[Port]:
    folder, tokens, settings = tmp_path / "recordings", tmp_path / "tokens.json", tmp_path / "macs.toml"
    folder.mkdir()
    audit = tmp_path / "audit.jsonl"
    settings.write_text(f'[gateway]\nrecordings = "{folder}"\naudit_file = "{audit}"\n')
    secrets = {}
    for name, rights in (("desk", Rights(may=["see", "record"], robots="any")), ("wall", Rights(may=["see"]))):
        secrets[name] = new_secret(os.urandom(32))
        token = Token(name=name, rights=rights, hashes=[hash_of(secrets[name])])
        store.change(tokens, lambda known, token=token: (known.with_token(token), None))
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(Program("router", "-l", endpoint))
        words = ["--port", "0", "--web-port", str(port), "--tokens", str(tokens), "--without-token", "nobody"]
        await stack.enter_async_context(Program("gateway", "--settings", str(settings), *words, "-e", endpoint))
        yield Port(folder, audit, f"http://127.0.0.1:{port}", secrets)


async def test_what_is_not_carried_out_is_no_success(port: Port) -> None:
    """No recorder, one that tells too much, one that refuses: each has its status, and the record the reason."""
    status, told = await port.post("stop")
    assert status == 502
    assert "macs record --serve" in told["error"]

    async def refuses(_: web.Request) -> web.Response:
        return web.json_response({"error": "nothing is being played"}, status=409)

    async def floods(_: web.Request) -> web.Response:
        return web.Response(body=bytes(recordings.ANSWER_BYTES + 1))

    async def does(_: web.Request) -> web.Response:
        return web.json_response({})

    path = socket_of(port.folder)
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    app = web.Application()
    app.router.add_post("/replay-stop", refuses)
    app.router.add_post("/start", floods)
    app.router.add_post("/ring", does)
    runner = web.AppRunner(app)
    await runner.setup()
    await web.UnixSite(runner, str(path)).start()
    try:
        assert await port.post("replay-stop") == (409, {"error": "nothing is being played"})
        assert await port.post("start") == (502, {"error": "the recorder tells too much"})
        assert await port.post("ring") == (200, {})
    finally:
        await runner.cleanup()
    await until(lambda: len(port.notes()) >= 4)
    results = {what: result for _, what, result in port.notes()}
    assert "macs record --serve" in results.pop("stop")
    assert results == {
        "replay-stop": "nothing is being played",
        "start": "the recorder tells too much",
        "ring": "done",
    }


async def test_who_asks_all_day_does_not_fill_the_record(port: Port) -> None:
    """A token without the right, and orders that are refused: noted at once, then once in a while."""
    for _ in range(30):
        assert await port.post("start", "wall") == (403, {"error": MISSING})
        await port.post("stop")
    await port.post("ring", "wall")
    await until(lambda: len(port.notes()) >= 3)
    assert [note[:2] for note in port.notes()] == [("wall", "start"), ("desk", "stop"), ("wall", "ring")]
