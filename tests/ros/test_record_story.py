"""docs/record.md, an incident step by step: each question of the story is asked, and answered by the file."""

from __future__ import annotations

import json
import os
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import Reader

import macs_zenoh
from bridge.headset.client import Headset
from bridge.recording.bag import Bag
from bridge.tokens import store
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.support.programs import Program, ended, macs
from tests.support.ros_peer import Peer
from tests.support.routers import Router
from tests.support.waiting import get, until

ROBOT = """
[robot]
id = 7
[[robot.rules]]
match = "/cmd_vel"
exclusive = true
hold_s = 60
deadman_s = 0.3
deadman_message = { linear = { z = -1 } }
[record]
after_s = 1.0
"""


@dataclass
class Incident:
    """A file, and who drove."""

    file: Path
    driver: str
    endpoint: str


@pytest.fixture
async def incident(domain: int, peer: Peer, tmp_path: Path) -> AsyncIterator[Incident]:
    """Anna's headset drives robot 7 and goes silent: the dead-man acts, and the ring is written by itself."""
    settings, tokens = tmp_path / "macs.toml", tmp_path / "tokens.json"
    settings.write_text(ROBOT)
    secret = new_secret(os.urandom(32))
    rights = Rights(may=["see", "command"], robots=[7])
    token = Token(name="anna", rights=rights, hashes=[hash_of(secret)])
    store.change(tokens, lambda known: (known.with_token(token), None))
    driven = await peer.subscription(Twist, "/cmd_vel")
    twist = Twist()
    twist.linear.x = 0.5
    async with Router() as router, AsyncExitStack() as stack:
        common = ("--settings", str(settings), "-e", router.endpoint)
        await stack.enter_async_context(Program("agent", *common, env={"ROS_DOMAIN_ID": str(domain)}))
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", "--tokens", str(tokens), *common))
        ring = (
            "--ring",
            "60s",
            "--commands",
            "--on",
            "stop",
            "--on",
            "deadman",
            "-o",
            str(tmp_path / "incident.mcap"),
        )
        recording = await stack.enter_async_context(Program("record", *ring, *common))
        me = int(recording.ready.split()[2].removeprefix("unity/"))
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port, token=secret))
        async with macs_zenoh.join("unity", connect=[router.endpoint]) as agent:

            async def follows() -> bool:
                return bool(json.loads(await agent.call("unity", me, "record"))["topics"] >= 2)

            commands = await headset.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[7])
            await until(follows, every_s=0.1)
        await commands.publish(bytes(serialize_message(twist)))
        assert (await get(driven)).linear.x == 0.5
        assert (await get(driven)).linear.z == -1

        async def written() -> Path | None:
            found = list(tmp_path.glob("incident_deadman_*.mcap"))
            code = (await ended("bag", "info", str(found[0])))[0] if found else 1
            return found[0] if code == 0 else None

        file = await until(written, every_s=0.2)
        yield Incident(file, f"unity/{headset.id}", router.endpoint)


async def test_an_incident_step_by_step(incident: Incident, tmp_path: Path) -> None:
    """What is in it and whether it is whole; who stopped the robot and why; who drove, by which token; what was sent,
    and what was carried out; and once more, as robot 70."""
    file, driver = incident.file, incident.driver
    info = await macs("bag", "info", "--json", str(file))
    assert info["lost"] == {}
    channels = {channel["topic"]: channel for channel in info["channels"]}
    assert channels[f"/sent/{driver}/7/cmd_vel"]["metadata"]["token"] == "anna"
    code, out, errors = await ended("bag", "events", "--json", str(file))
    assert code == 0, errors
    events = [json.loads(line) for line in out.splitlines()]
    assert [event["robot"] for event in events if event["kind"] == "deadman"] == [7]
    assert any("/cmd_vel acted: " in event["text"] for event in events if event["kind"] == "deadman")
    assert any(event["text"] == f"{driver} has control of /cmd_vel" for event in events)
    with Bag(file) as bag:
        tokens = [json.loads(m.data) for m in bag.messages(lambda channel: channel.topic == "/macs/tokens")]
        assert [(each["agent"], each["token"]) for each in tokens if each["token"]] == [(driver, "anna")]
        assert channels[f"/sent/{driver}/7/cmd_vel"]["messages"] == 1
        assert channels["/7/cmd_vel"]["messages"] >= 2  # what was carried out: his, and the dead-man's
    code, _, errors = await ended("bag", "to-rosbag2", str(file), "-o", str(tmp_path / "ros"))
    assert code == 0, errors
    with Reader(tmp_path / "ros") as reader:
        assert "/robot_7/cmd_vel" in {connection.topic for connection in reader.connections}
    async with (
        Program("replay", str(file), "--as-robot", "7:70", "-e", incident.endpoint),
        macs_zenoh.join("unity", connect=[incident.endpoint]) as agent,
    ):
        await until(lambda: (1, 70) in agent.directory)
        offered = json.loads(await agent.call("ros", 70, "offers"))
        assert offered["replay"] is True
        with pytest.raises(macs_zenoh.Refused):
            await agent.advertise("/cmd_vel", robot=70, type="geometry_msgs/Twist")
