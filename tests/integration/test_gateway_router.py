"""A gateway that is the router of its mesh, too."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

import macs_zenoh
from benchmarks.headset import Headset
from bridge.headset import frames
from macs_zenoh.config import MeshSettings
from tests.support.programs import Program, ended, free_port
from tests.support.waiting import PATIENCE_S, until


@pytest.mark.parametrize("namespace", [None, "site1"])
async def test_agents_and_headsets_reach_each_other_through_it(namespace: str | None) -> None:
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    options = ["--namespace", namespace] if namespace else []
    async with Program("gateway", "-m", "router", "-l", endpoint, "--port", str(port), *options):
        settings = MeshSettings(connect=[endpoint], namespace=namespace)
        async with macs_zenoh.join("ros", id=7, settings=settings) as robot:
            got: list[macs_zenoh.Message] = []
            robot.on_message(got.append)
            headset = await asyncio.to_thread(Headset.join, port, 0)
            await until(lambda: ("unity", headset.id) in {(each.type_name, each.id) for each in robot.online()})
            question = frames.plain_data(headset.id, b"{}", to_type=1, ids=[7], request_id=5)
            headset.socket.sendall(question)
            await until(lambda: bool(got))
            robot.reply(got[0], b'{"answer": 1}')
            headset.socket.settimeout(PATIENCE_S)
            answer = bytearray()
            while b'{"answer": 1}' not in answer:
                answer += await asyncio.to_thread(headset.socket.recv, 65536)
            headset.socket.close()


async def test_it_refuses_access_rules_that_would_not_hold_it(tmp_path: Path) -> None:
    rules = {"enabled": True, "default_permission": "deny", "rules": [], "subjects": [], "policies": []}
    config = tmp_path / "rules.json5"
    config.write_text(json.dumps({"access_control": rules}))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    words = ("gateway", "-m", "router", "-l", endpoint, "-c", str(config), "--port", "0")
    code, _, said = await ended(*words)
    assert (code, "access rules do not hold a gateway that is the router" in said) == (2, True), said
