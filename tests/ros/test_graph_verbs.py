"""`macs topic`, `macs service` and `macs action` with a real robot, over the mesh and without a gateway."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import sys
import threading
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped, Twist
from rclpy.action import ActionServer
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import SetBool

from tests.support.processes import ROOT
from tests.support.programs import Program, ended, free_port, macs
from tests.support.ros_peer import Peer, set_bool
from tests.support.waiting import PATIENCE_S, get, until

SETTINGS = """
[robot]
id = 7
group = 3
"""


@dataclass
class Site:
    """Robot 7 and the ROS node beside its agent."""

    endpoint: str
    peer: Peer
    driven: asyncio.Queue[Any]
    robot: Program

    async def macs(self, *argv: str) -> tuple[int, str, str]:
        return await ended(*argv, "-e", self.endpoint)

    async def offered(self, *names: str) -> None:
        """Wait until the robot tells of these."""

        async def told() -> bool:
            code, out, _ = await self.macs("ls", "-v", "--json")
            return code == 0 and all(f'"{name}"' in out for name in names)

        await until(told, every_s=0.2)


async def say(peer: Peer, publisher: Any, message: Any) -> None:
    while True:
        await peer.session.run(lambda: publisher.publish(message))
        await asyncio.sleep(0.02)


@pytest.fixture
async def site(domain: int, peer: Peer, tmp_path: Path) -> AsyncIterator[Site]:
    settings = tmp_path / "macs.toml"
    settings.write_text(SETTINGS)
    driven = await peer.subscription(Twist, "/cmd_vel")
    chatter = await peer.publisher(String, "/chatter")
    picture = await peer.publisher(Image, "/picture")
    await peer.session.run(lambda: peer.session.node.create_service(SetBool, "/set", set_bool))
    talking = [
        asyncio.create_task(say(peer, chatter, String(data="hello from ROS"))),
        asyncio.create_task(say(peer, picture, Image(width=2, height=2, step=2, data=bytes(400)))),
    ]
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        await stack.enter_async_context(Program("router", "-l", endpoint))
        robot = Program("agent", "--settings", str(settings), "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)})
        await stack.enter_async_context(robot)
        site = Site(endpoint, peer, driven, robot)
        await site.offered("/chatter", "/cmd_vel", "/set", "/picture")
        yield site
    for task in talking:
        task.cancel()


async def test_what_robots_have_is_listed(site: Site) -> None:
    """Topics with types and robots, about one of them all that is known, and services; as text and for programs."""
    assert (await site.macs("topic", "list"))[:2] == (0, "/chatter\n/cmd_vel\n/picture\n")
    _, typed, _ = await site.macs("topic", "list", "-t", "--robot", "7")
    assert typed.splitlines()[1] == "/cmd_vel [geometry_msgs/msg/Twist]"
    _, by_end, _ = await site.macs("topic", "list", "-v", "--group", "3")
    assert "Subscribed topics:\n * /cmd_vel [geometry_msgs/msg/Twist] robot 7\n" in by_end
    rows = await macs("topic", "list", "--json", "-e", site.endpoint)
    assert rows[1] == {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "publishers": [], "subscribers": [7]}
    assert (await site.macs("topic", "list", "--count-topics"))[1] == "3\n"

    code, shown, _ = await site.macs("topic", "info", "cmd_vel", "-v")
    assert code == 0
    assert shown.startswith("Type: geometry_msgs/msg/Twist\nPublisher count: 0\nSubscription count: 1 (robot 7)\n")
    assert "Reliability: RELIABLE" in shown
    definition = shown[shown.index("\nDefinition (robot 7):\n") :]
    assert re.match(r"\nDefinition \(robot 7\):\n  geometry_msgs/msg/Twist( RIHS01_[0-9a-f]{64})?\n", definition)
    assert "    Vector3  linear\n    Vector3  angular\n" in definition
    assert re.search(r"\n  geometry_msgs/msg/Vector3( RIHS01_[0-9a-f]{64})?\n(    .*\n)*    float64 x\n", definition)
    told = await macs("topic", "info", "/cmd_vel", "-v", "--json", "-e", site.endpoint)
    (defined,) = told["definitions"]
    assert (defined["robots"], defined["missing"]) == ([7], {})
    assert set(defined["types"]) == {"geometry_msgs/msg/Twist", "geometry_msgs/msg/Vector3"}
    assert "definitions" not in await macs("topic", "info", "/cmd_vel", "--json", "-e", site.endpoint)
    code, _, log = await site.macs("topic", "info", "/cmdvel")
    assert code == 1
    assert "did you mean /cmd_vel?" in log

    assert (await site.macs("service", "list", "-t"))[1] == "/set [std_srvs/srv/SetBool]\n"
    assert await macs("service", "list", "--json", "-e", site.endpoint) == [
        {"service": "/set", "type": "std_srvs/srv/SetBool", "robots": [7]}
    ]
    code, _, log = await site.macs("topic", "list", "--robot", "8")
    assert (code, "robot 8 cannot be reached: it is not online" in log) == (1, True)


async def test_messages_are_shown(site: Site) -> None:
    """As YAML, as JSON, as CSV, one field of them, once and so many times; what a robot does not have is told."""
    assert (await site.macs("topic", "echo", "/chatter", "--once"))[:2] == (0, "data: hello from ROS\n---\n")
    code, out, _ = await site.macs("topic", "echo", "/chatter", "--count", "3", "--json", "--robot", "7")
    assert code == 0
    assert [json.loads(line) for line in out.splitlines()] == 3 * [
        {"topic": "/chatter", "robot": 7, "message": {"data": "hello from ROS"}}
    ]
    assert (await site.macs("topic", "echo", "/chatter", "-1", "--field", "data", "--csv"))[1] == "hello from ROS\n"
    _, summary, _ = await site.macs("topic", "echo", "/picture", "sensor_msgs/msg/Image", "-1", "--field", "data")
    assert summary == "bytes: 400\n---\n"
    code, _, log = await site.macs("topic", "echo", "/chatter", "-1", "--field", "date")
    assert code == 2
    assert log.strip().endswith("there is no field date (there is: data)")
    code, _, log = await site.macs("topic", "echo", "/chater", "--once")
    assert code == 1
    assert "did you mean /chatter?" in log
    code, out, _ = await site.macs("topic", "echo", "/cmd_vel", "--once", "--timeout", "0.5")
    assert (code, out) == (1, "")


async def test_rates_sizes_and_ages_are_measured(site: Site) -> None:
    """Each says what it saw of a robot's topic; a type without a header has no age."""
    code, out, _ = await site.macs("topic", "hz", "/chatter", "--count", "20", "--json")
    assert code == 0
    last = json.loads(out.splitlines()[-1])
    assert (last["topic"], last["robot"], last["window"]) == ("/chatter", 7, 20)
    assert 0 < last["rate_hz"] < 100
    _, out, _ = await site.macs("topic", "bw", "/chatter", "--count", "20")
    assert "KB/s from 20 messages" in out or " B/s from 20 messages" in out
    assert re.search(r"Message size mean: 2\d B min: 2\d B max: 2\d B\n", out)
    code, _, log = await site.macs("topic", "delay", "/chatter", "--count", "2")
    assert code == 2
    assert "have no header" in log

    pose = PoseStamped()
    pose.header.stamp = (await site.peer.session.run(lambda: site.peer.session.node.get_clock().now())).to_msg()
    publisher = await site.peer.publisher(PoseStamped, "/pose")
    talking = asyncio.create_task(say(site.peer, publisher, pose))
    await site.offered("/pose")
    code, out, log = await site.macs("topic", "delay", "/pose", "--count", "3", "--json")
    talking.cancel()
    assert code == 0, log
    assert "the clock of robot 7 is " in log
    assert json.loads(out.splitlines()[-1])["delay_s"] > 0


async def test_age_and_size_are_those_that_rclpy_sees(site: Site) -> None:
    """Of a stamped topic: what `delay` and `bw` say here, and what a subscription on the robot says."""
    node, session = site.peer.session.node, site.peer.session
    publisher = await site.peer.publisher(PoseStamped, "/pose")
    received = await site.peer.subscription(PoseStamped, "/pose", 1000)
    ages: list[float] = []

    def publish() -> None:
        pose = PoseStamped()
        pose.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(pose)

    async def talk() -> None:
        while True:
            await session.run(publish)
            stamp = (await get(received)).header.stamp
            ages.append(time.time() - stamp.sec - stamp.nanosec / 1e9)
            await asyncio.sleep(0.02)

    talking = asyncio.create_task(talk())
    try:
        await site.offered("/pose")
        began = len(ages)
        code, out, log = await site.macs("topic", "delay", "/pose", "--count", "50", "--json")
        assert code == 0, log
        there = ages[began:]
        here = json.loads(out.splitlines()[-1])
        assert here["window"] == 50
        assert abs(here["delay_s"] - sum(there) / len(there)) < 0.25  # the mesh, and a busy machine
        assert here["min_s"] > -0.05
        code, out, log = await site.macs("topic", "bw", "/pose", "--count", "50", "--json")
        assert code == 0, log
        size = len(serialize_message(PoseStamped()))
        here = json.loads(out.splitlines()[-1])
        assert size <= here["mean_bytes"] <= size + 8  # DDS pads what it carries
        assert here["bytes_per_s"] == pytest.approx(here["mean_bytes"] * 50 / 1.0, rel=1.0)
    finally:
        talking.cancel()


async def test_publishing_reaches_ros_and_says_why_not(site: Site) -> None:
    """YAML and JSON arrive; a robot that is stopped refuses with its reason, and the exit code is 1."""
    code, out, log = await site.macs("topic", "pub", "/cmd_vel", "linear: {x: 0.25}", "-1", "--robot", "7")
    assert (code, out.splitlines()[0][:14]) == (0, "publishing #1:"), log
    assert (await get(site.driven)).linear.x == 0.25
    twist = ("geometry_msgs/msg/Twist", '{"linear": {"x": 0.5}}')
    code, out, _ = await site.macs("topic", "pub", "/cmd_vel", *twist, "-t", "3", "-r", "50", "--json")
    assert (code, json.loads(out)) == (0, {"topic": "/cmd_vel", "sent": 3, "refused": []})
    assert [(await get(site.driven)).linear.x for _ in range(3)] == [0.5] * 3

    assert (await site.macs("stop", "7"))[0] == 0
    code, _, log = await site.macs("topic", "pub", "/cmd_vel", *twist, "-1")
    assert code == 1
    assert "robot 7: " in log
    assert "stop" in log
    code, out, _ = await site.macs("topic", "pub", "/cmd_vel", *twist, "-1", "--json")
    assert code == 1
    assert json.loads(out)["refused"][0]["robot"] == 7
    assert site.driven.empty()


@pytest.mark.parametrize(
    ("argv", "code", "said"),
    [
        (("/cmdvel", "geometry_msgs/msg/Twist", "{}", "-1"), 1, "did you mean /cmd_vel?"),
        (("/cmd_vel", "linear: {w: 1}", "-1"), 2, "linear.w: no such field (there is: x, y, z)"),
        (("/cmd_vel", "linear: [", "-1"), 2, "neither YAML nor JSON"),
        (("/cmd_vel", "std_msgs/msg/String", "data: a", "-1"), 1, "geometry_msgs/msg/Twist"),
        (("/cmd_vel", "{}", "-1", "--robot", "9"), 1, "robot 9 cannot be reached: it is not online"),
        (("/cmd_vel", "{}", "-1", "--as", "observer"), 2, "an observer is nobody"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
async def test_what_cannot_be_published_is_told(site: Site, argv: tuple[str, ...], code: int, said: str) -> None:
    """In one line, before anything is sent, and nothing moves."""
    ended_with, _, log = await site.macs("topic", "pub", *argv)
    assert ended_with == code, log
    assert said in log.splitlines()[-1]
    assert site.driven.empty()


async def test_services_are_called(site: Site) -> None:
    """With YAML or without a request; what is not there or not answered is told."""
    code, out, _ = await site.macs("service", "call", "/set", "data: true")
    assert (code, out) == (0, "response:\nsuccess: true\nmessage: set to True\n\n")
    code, out, _ = await site.macs("service", "call", "/set", "std_srvs/srv/SetBool", "--json", "--group", "3")
    line = json.loads(out)
    assert line.pop("ms") > 0
    assert line == {"service": "/set", "robot": 7, "response": {"success": False, "message": "set to False"}}
    code, _, log = await site.macs("service", "call", "/sett")
    assert (code, "did you mean /set?" in log) == (1, True)
    code, _, log = await site.macs("service", "call", "/set", "date: true")
    assert (code, "no such field (there is: data)" in log) == (2, True)


async def test_goals_are_given(site: Site, count_action: Any) -> None:
    """A goal with its feedback and result; one that does not succeed is exit code 1."""

    def execute(handle: Any) -> Any:
        for number in range(handle.request.to):
            handle.publish_feedback(count_action.Feedback(at=number))
        handle.succeed()
        return count_action.Result(reached=handle.request.to)

    node = site.peer.session.node
    server = await site.peer.session.run(lambda: ActionServer(node, count_action, "/count", execute))
    await site.offered("/count")
    assert (await site.macs("action", "list", "-t"))[1] == "/count [macs_test_msgs/action/Count]\n"
    code, out, log = await site.macs("action", "send", "/count", "to: 2", "--feedback")
    assert code == 0, log
    assert "Goal accepted with ID: " in out
    assert "Result:\n    reached: 2\n" in out
    assert out.endswith("Goal finished with status: SUCCEEDED\n")
    code, out, _ = await site.macs("action", "send", "/count", "to: 1", "--json")
    last = json.loads(out.splitlines()[-1])
    assert last == {"action": "/count", "robot": 7, "status": "succeeded", "result": {"reached": 1, "text": ""}}
    assert (await site.macs("stop", "7"))[0] == 0
    code, _, log = await site.macs("action", "send", "/count", "to: 2")
    assert code == 1
    assert "stop" in log.splitlines()[-1]
    await site.peer.session.run(server.destroy)


async def test_a_goal_whose_robot_is_killed_has_an_end(site: Site, count_action: Any) -> None:
    """Who waits for its result without a time limit hears that the robot has left: exit code 1."""
    go = threading.Event()

    def execute(handle: Any) -> Any:
        go.wait(PATIENCE_S)
        handle.succeed()
        return count_action.Result()

    node = site.peer.session.node
    server = await site.peer.session.run(lambda: ActionServer(node, count_action, "/count", execute))
    await site.offered("/count")
    sending = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "bridge", "action", "send", "/count", "to: 2", "-e", site.endpoint),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert sending.stdout is not None
    while b"Goal accepted" not in await asyncio.wait_for(sending.stdout.readline(), PATIENCE_S):
        assert sending.returncode is None
    await site.robot.stop(signal.SIGKILL)
    _, log = await asyncio.wait_for(sending.communicate(), PATIENCE_S)
    go.set()
    assert sending.returncode == 1
    last = log.decode().splitlines()[-1]
    assert "robot 7 cannot be reached: it has left" in last
    await site.peer.session.run(server.destroy)


async def test_to_be_stopped_is_the_good_end_of_what_has_none(site: Site) -> None:
    """Ctrl-C ends `echo` with 0, and what was to show so many messages with 130."""
    for options, code in (((), 0), (("--count", "1000000"), 130)):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "bridge", "topic", "echo", "/chatter", "-e", site.endpoint, *options),
            cwd=ROOT,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
        )
        assert process.stdout is not None
        assert await asyncio.wait_for(process.stdout.readline(), 60) == b"data: hello from ROS\n"
        process.send_signal(signal.SIGINT)
        await asyncio.wait_for(process.communicate(), 60)
        assert process.returncode == code


async def test_of_several_robots_one_is_named(site: Site) -> None:
    """To listen, all are meant; to act, nobody is chosen who was not named."""
    import macs_zenoh

    async with macs_zenoh.join("ros", id=8, connect=[site.endpoint]):
        code, _, log = await site.macs("topic", "pub", "/cmd_vel", "{}", "-1")
        assert (code, "robots 7, 8 are online: say which one is meant" in log) == (2, True)
        code, _, log = await site.macs("service", "call", "/set")
        assert code == 2
        assert site.driven.empty()


async def test_the_rate_of_a_fast_sensor_is_right(domain: int, site: Site) -> None:
    """Of a topic with 1000 messages a second, `hz` says what the sensor itself counted."""
    sensor = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "tests.ros.imu",
        "1000",
        cwd=ROOT,
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        await site.offered("/imu")
        code, out, log = await site.macs("topic", "hz", "/imu", "--count", "5000", "--json")
        assert code == 0, log
        assert sensor.stdin is not None
        sensor.stdin.close()
        told, _ = await asyncio.wait_for(sensor.communicate(), 60)
    finally:
        if sensor.returncode is None:
            sensor.kill()
            await sensor.wait()
    last = json.loads(out.splitlines()[-1])
    assert last["window"] == 5000
    assert last["rate_hz"] == pytest.approx(float(told), rel=float(os.environ.get("MACS_HZ_WITHIN", "0.1")))
