"""A robot's record: who registered, had control, stopped it and released it, and who was not allowed to."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from macs_zenoh.errors import Refused
from macs_zenoh.protocol.messages import encode_data
from macs_zenoh.protocol.robot_state import ControlRequest
from tests.ros.driven import hear, may_command, send, send_bool, site
from tests.support.programs import ended
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, until

SETTINGS = """
[robot]
audit_file = "{file}"
release_allow = ["operator"]
[[robot.rules]]
match = "/cmd_vel"
exclusive = true
hold_s = 60
"""


async def test_a_robot_keeps_a_record(domain: int, peer: Peer, tmp_path: Path) -> None:
    """Control by the first command, handed over, given up; a stop, a release that is refused, and one that is not."""
    path = tmp_path / "audit.jsonl"
    heard = await hear(peer)
    async with site(domain, tmp_path, SETTINGS.format(file=path)) as place, place.robot() as robot:
        async with place.headset(300) as one, place.headset(301) as other:
            for driver in (one, other):
                await may_command(driver, 1)
            await until(lambda: send(one, 1, 0.5) or heard.values)
            give = encode_data(ControlRequest("give", "/cmd_vel", to=301))
            await one.call("ros", 1, "control", give)
            await one.call("ros", 1, "control", encode_data(ControlRequest("take", "/cmd_vel")))
            await other.call(
                "ros", 1, "control", encode_data(ControlRequest("release", "/cmd_vel")), timeout_s=PATIENCE_S
            )
            send_bool(one, 1, True)
            await until(lambda: '"stop"' in path.read_text())
            with pytest.raises(Refused):
                await one.call("ros", 1, "stop", b"false")
            code, _, errors = await ended("stop", "1", "--release", "-e", place.router.endpoint)
            assert code == 0, errors
        assert await robot.stop() == 0
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    told = [(line["event"], line["by"].get("agent"), line["what"], line["result"] == "done") for line in lines]
    assert told[0][0] == "started"
    assert set(told[1:3]) == {("register", f"unity/{number}", "type 2 /cmd_vel", True) for number in (300, 301)}
    assert told[3:10] == [
        ("control_taken", "unity/300", "/cmd_vel", True),
        ("control_given", "unity/300", "/cmd_vel to unity/301", True),
        ("control_taken", "unity/300", "/cmd_vel", False),
        ("control_released", "unity/301", "/cmd_vel", True),
        ("stop", "unity/300", "/emergency_stop", True),
        ("release", "unity/300", "/emergency_stop", False),
        ("release", "operator/0", "/emergency_stop", True),
    ]
    assert told[-1][0] == "stopped"
    code, out, _ = await ended("audit", "verify", str(path))
    assert code == 0, out
