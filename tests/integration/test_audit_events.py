"""A gateway's record has every kind of event that docs/audit.md says a gateway writes, each with who it was."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import aiohttp
import pytest

import macs_zenoh
from bridge.headset.client import Headset
from bridge.tokens import store
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.messages import UNITY, AddNode, RemoveNode
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_pairing, new_secret
from macs_zenoh.serving import Call
from tests.support.audit_events import events_of
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.programs import Program, ended, free_port
from tests.support.waiting import until


async def test_a_gateway_writes_each_kind_of_event(tmp_path: Path) -> None:
    """Joins, sleeps, registers, is refused, is paired, changed and revoked: nothing of the table is missing, and
    whoever did it is named by id, address and token."""
    endpoint, web = f"tcp/127.0.0.1:{free_port()}", free_port()
    path, file = tmp_path / "audit.jsonl", tmp_path / "tokens.json"
    settings = tmp_path / "macs.toml"
    settings.write_text(
        f'[gateway]\naudit_file = "{path}"\ntokens_file = "{file}"\nweb_port = {web}\n'
        'plain_without_token = "nobody"\nweb_without_token = "nobody"\n'
    )
    command = ("gateway", "--settings", str(settings), "--port", "0", "-e", endpoint)

    def lines() -> list[dict[str, Any]]:
        return [json.loads(line) for line in path.read_bytes().splitlines()]

    async def noted(event: str, result: str = "") -> None:
        await until(lambda: any(line["event"] == event and result in line["result"] for line in lines()))

    def change(may: list[str], secret: str) -> None:
        rights = Rights(may=may, robots=[1])  # type: ignore[arg-type]
        token = Token(name="anna", rights=rights, hashes=[hash_of(secret)])
        store.change(file, lambda tokens: (tokens.with_token(token), None))

    async def takes(call: Call) -> bytes:
        return b""

    async with (
        Program("router", "-l", endpoint),
        Program(*command) as one,
        macs_zenoh.join("ros", id=1, settings=patient(endpoint)) as robot,
    ):
        for verb in (AddNode, RemoveNode):
            robot.serve("add_node" if verb is AddNode else "remove_node", takes)
        secret = new_secret(os.urandom(32))
        change(["see"], secret)
        await noted("token_created")
        with pytest.raises(MacsError):
            async with await Headset.connect("127.0.0.1", one.port) as stranger:
                await stranger.online()
        await noted("refused", "no valid token")
        pairing = new_pairing("anna", "123456", os.urandom(32), time.time())
        store.change(file, lambda tokens: (tokens.with_pairing(pairing, time.time()), None))
        async with (
            aiohttp.ClientSession() as session,
            session.post(f"http://127.0.0.1:{web}/pair", json={"code": "123456"}) as response,
        ):
            assert response.status == 200
        await noted("token_paired")
        async with await Headset.connect("127.0.0.1", one.port, token=secret, reconnect=True) as anna:
            agent = f"unity/{anna.id}"
            await until(lambda: (UNITY, anna.id) in robot.directory)
            topic = await anna.subscribe("/pose", "std_msgs/String", agents=[1])
            await noted("register")
            await topic.close()
            await noted("deregister")
            await anna.advertise("/cmd_vel", "std_msgs/String", agents=[1])
            await noted("register", "right to command")
            await anna.send(b"x", to=UNITY, ids=[anna.id])
            await noted("message", "right to send")
            await until(lambda: anna._session is not None and anna._session.secret)
            anna.drop_connection()
            for event in ("asleep", "resumed"):
                await noted(event)
            await until(lambda: anna.connected)
            change(["see", "send"], secret)
            for event in ("token_changed", "rights_changed"):
                await noted(event)
            store.change(file, lambda tokens: (tokens.without("anna"), None))
            await anna.wait_ended()
            for event in ("token_removed", "token_ended", "left"):
                await noted(event)
        assert await one.stop() == 0
        # orders to a recorder are tried in test_recordings_port
        assert {line["event"] for line in lines()} == events_of("gateway", "both") - {"recording"}
    of_anna = [line for line in lines() if line["event"] in ("joined", "asleep", "resumed", "left", "token_ended")]
    assert {(line["by"]["agent"], line["by"]["token"]) for line in of_anna} == {(agent, "anna")}
    assert all(line["by"]["address"].startswith("127.0.0.1:") for line in of_anna)
    for line in lines():
        about = set(line["by"])
        assert about or line["event"] in ("started", "stopped"), line
        assert about == {"token"} or not line["event"].startswith("token_") or line["event"] == "token_ended"
    code, out, _ = await ended("audit", "verify", str(path))
    assert code == 0, out


async def test_requests_of_the_web_port_are_counted_and_noted(start_gateway: StartGateway, tmp_path: Path) -> None:
    """A wrong token at the login, with a question or with a WebSocket is counted as at the other ports, and in the
    record with its address; the thousandth is no line of its own."""
    path = tmp_path / "audit.jsonl"
    gateway = await start_gateway(
        audit_file=str(path), tokens_file=str(tmp_path / "t.json"), web_port=0, web_without_token="nobody"
    )
    here = f"http://127.0.0.1:{gateway.listeners.web_port}"
    began = time.monotonic()
    async with aiohttp.ClientSession() as session:
        for _ in range(30):
            async with session.post(f"{here}/login", json={"token": "macs_wrong"}) as response:
                assert response.status == 401
            async with session.post(f"{here}/pair", json={"code": "000000"}) as response:
                assert response.status == 401
            async with session.get(f"{here}/view/mesh", headers={"Authorization": "Bearer macs_wrong"}) as response:
                assert response.status == 401
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await session.ws_connect(f"{here}/macs", protocols=("macs.v1", "macs.token.macs_wrong"))
    assert gateway.drops["NotAdmitted"] == 120
    await gateway.close()
    refused = [line for line in map(json.loads, path.read_bytes().splitlines()) if line["event"] == "refused"]
    assert 1 <= len(refused) <= 1 + (time.monotonic() - began) // 60
    assert refused[0]["by"] == {"address": "127.0.0.1"}
