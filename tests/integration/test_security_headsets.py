"""Tokens of a policy's headsets, tried at gateways that run."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

from bridge.security import policy
from bridge.security.generate import generate
from bridge.security.headsets import try_headsets
from tests.support.given import StartGateway
from tests.support.programs import free_port

POLICY = """
routers: [{{name: site, addresses: [127.0.0.1]}}]
robots: [{{name: robot-7, id: 7, group: 3}}, {{name: robot-8, id: 8}}]
gateways:
  - {{name: hall-1, ports: [tcp/127.0.0.1:{one}, ws/127.0.0.1:{web}]}}
  - {{name: hall-2, ports: [tcp/127.0.0.1:{two}]}}
headsets:
  - {{name: anna, gateways: [hall-1], may: [see, act], robots: [robot-7], groups: [3], topics: ["/camera/**"]}}
  - {{name: bert, may: [command], robots: any}}
permissions: [{{who: all, may: all, whom: all}}]
"""


async def test_gateways_are_held_to_their_headsets_rights(start_gateway: StartGateway, tmp_path: Path) -> None:
    """What a gateway does by its file of tokens is as expected, on each port; with another's file it is not."""
    one, two, web = free_port(), free_port(), free_port()
    read = policy.parse(POLICY.format(one=one, two=two, web=web))
    generate(read, tmp_path, dt.datetime.now(dt.timezone.utc))
    nobody = {"plain_without_token": "nobody", "web_without_token": "nobody"}
    await start_gateway(port=one, web_port=web, tokens_file=str(tmp_path / "hall-1" / "tokens.json"), **nobody)
    await start_gateway(port=two, tokens_file=str(tmp_path / "hall-2" / "tokens.json"), **nobody)
    results = await try_headsets(read, tmp_path, 10.0)
    assert [result for result in results if not result.as_expected] == []
    assert len(results) >= 50
    assert {result.permitted for result in results} == {True, False}
    mixed = (tmp_path / "hall-1" / "tokens.json").read_bytes()
    (tmp_path / "hall-2" / "tokens.json").write_bytes(mixed)
    wrong = [result for result in await try_headsets(read, tmp_path, 10.0) if not result.as_expected]
    assert [result.what for result in wrong] == ["anna is let in"]
    assert wrong[0].router.startswith("hall-2")
