"""A robot's record has every kind of event that docs/audit.md says a robot writes, each with who it was."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from macs_zenoh.errors import Refused
from macs_zenoh.protocol.messages import AddNode, NodeType, RemoveNode, encode_data, node_name
from macs_zenoh.protocol.robot_state import ControlRequest
from tests.ros.driven import hear, may_command, send, send_bool, site
from tests.support.audit_events import events_of
from tests.support.programs import ended
from tests.support.ros_peer import Peer
from tests.support.waiting import until

SETTINGS = """
[robot]
audit_file = "{file}"
[[robot.rules]]
match = "/cmd_vel"
exclusive = true
hold_s = 60
"""


async def test_a_robot_writes_each_kind_of_event(domain: int, peer: Peer, tmp_path: Path) -> None:
    """Registered, refused and left again; control taken, given and released; stopped and released; begun and ended."""
    path = tmp_path / "audit.jsonl"
    heard = await hear(peer)

    def lines() -> list[dict[str, Any]]:
        return [json.loads(line) for line in path.read_text().splitlines()]

    async def noted(event: str) -> None:
        await until(lambda: any(line["event"] == event for line in lines()))

    async with site(domain, tmp_path, SETTINGS.format(file=path)) as place, place.robot() as robot:
        async with place.headset(300) as one, place.headset(301) as other:
            for driver in (one, other):
                await may_command(driver, 1)
            unknown = AddNode(2, 300, NodeType.PUBLISHER, node_name("/x"), "/x", "nobody_has/Such")
            with pytest.raises(Refused):
                await one.call("ros", 1, "add_node", encode_data(unknown), timeout_s=20)
            await until(lambda: send(one, 1, 0.5) or heard.values)
            await one.call("ros", 1, "control", encode_data(ControlRequest("give", "/cmd_vel", to=301)))
            await other.call("ros", 1, "control", encode_data(ControlRequest("release", "/cmd_vel")))
            send_bool(one, 1, True)
            await noted("stop")
            code, _, errors = await ended("stop", "1", "--release", "-e", place.router.endpoint)
            assert code == 0, errors
            leaving = RemoveNode(2, 300, NodeType.PUBLISHER, node_name("/cmd_vel"))
            await one.call("ros", 1, "remove_node", encode_data(leaving), timeout_s=20)
            for event in ("release", "deregister"):
                await noted(event)
        assert await robot.stop() == 0
    assert {line["event"] for line in lines()} == events_of("robot", "both")
    assert all(line["by"].get("agent") for line in lines() if line["event"] not in ("started", "stopped"))
    assert [line["what"] for line in lines() if line["event"] == "register" and line["result"] != "done"] == [
        "type 2 /x"
    ]
