"""What is wrong in a robot's safety settings is found when it starts, not when a headset needs it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from geometry_msgs.msg import Twist
from std_msgs.msg import String

from bridge.ros.checked import CheckedSettings
from bridge.ros.interface import Drops
from bridge.ros.rclpy_side import RclpySide
from bridge.ros.rules import Rules
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.errors import Refused
from macs_zenoh.presses import STOP_NAME
from macs_zenoh.protocol.messages import AddNode, NodeType, encode_data
from tests.ros.driven import driving, hear, may_command, site
from tests.support.programs import ended
from tests.support.ros_peer import Peer
from tests.support.waiting import until

WRONG = """
[[robot.rules]]
match = "/cmd_vel"
deadman_s = 0.5
deadman_message = { linaer = { x = 0.0 } }
"""


async def test_a_dead_man_that_does_not_fit_its_type_is_told_at_the_start(
    domain: int, peer: Peer, tmp_path: Path
) -> None:
    """The graph has the topic: the log names the field, and `macs doctor` is not content."""
    await peer.subscription(Twist, "/cmd_vel")
    async with site(domain, tmp_path, WRONG) as place, place.robot() as robot:
        await until(lambda: any("Twist has no field linaer" in line for line in robot.log))
        code, out, errors = await ended("doctor", "--json", "--quick", "-e", place.router.endpoint)
        assert code == 1, errors
        found = [finding for finding in json.loads(out)["findings"] if finding["id"] == "wrong_settings"]
        assert [finding["severity"] for finding in found] == ["error"]


async def test_a_robot_without_its_emergency_stop_is_found_and_gets_it(
    domain: int, peer: Peer, tmp_path: Path
) -> None:
    """While its topic has another type `macs doctor` names that and no command is carried out; when that is gone, the
    robot can be stopped, and driven."""
    wheels = Peer(domain, "wheels")
    heard = await hear(wheels)
    await peer.subscription(String, "/emergency_stop")
    async with site(domain, tmp_path) as place, place.robot() as robot, place.headset() as driver:

        async def has_none() -> bool:
            if any("/emergency_stop: emergency stop" in line for line in robot.log):  # it was quicker than ROS
                await robot.stop()
                robot.log.clear()
                await robot.start()
            return any("there is no emergency stop," in line for line in robot.log)

        await until(has_none, every_s=0.2)
        code, out, errors = await ended("doctor", "--json", "--quick", "-e", place.router.endpoint)
        found = [finding for finding in json.loads(out)["findings"] if finding["id"] == "no_stop"]
        assert [finding["severity"] for finding in found] == ["error"], errors
        assert code == 1
        await may_command(driver, 1)
        takes = AddNode(*driver.key, NodeType.SUBSCRIBER, STOP_NAME, "/emergency_stop", "std_msgs/String")
        await driver.call("ros", 1, "add_node", encode_data(takes), timeout_s=20)  # it must not keep the other type
        async with driving(driver, 1):

            async def refused() -> bool:
                status = json.loads(await driver.call("ros", 1, "status"))
                return bool(status["drops"].get("no_stop", 0) >= 5)

            await until(refused)
            with pytest.raises(Refused, match=r"no emergency stop yet.*String"):
                await driver.call("ros", 1, "stop", b"true")
            assert not heard.values
            peer.session.close()
            await until(lambda: heard.last == 0.5)
        await until(lambda: any("there is an emergency stop now" in line for line in robot.log))
        await driver.call("ros", 1, "stop", b"true")
        assert json.loads(await driver.call("ros", 1, "status"))["stopped"]
    wheels.session.close()


async def test_two_agents_on_one_graph_are_found(domain: int, tmp_path: Path) -> None:
    """`macs doctor` names the graph that two robots share."""
    async with site(domain, tmp_path) as place, place.robot(1) as first, place.robot(2):
        await until(lambda: any("works on this ROS graph too" in line for line in first.log))
        _, out, errors = await ended("doctor", "--json", "--quick", "-e", place.router.endpoint)
        found = [finding for finding in json.loads(out)["findings"] if finding["id"] == "shared_graph"]
        assert len(found) == 2, errors


def test_each_message_is_compared_once_with_the_types_that_there_are() -> None:
    """Topics and services, also such with several types; what is not installed is left to whoever registers it."""
    drops = Drops()
    rules = [
        TopicRule(match="/cmd_vel", deadman_message={"linear": {"x": "fast"}}),
        TopicRule(match="/good", deadman_message={"linear": {"x": 1}}),
        TopicRule(match="/set", error_response={"sucess": False}),
    ]
    checked = CheckedSettings(RclpySide(), Rules(RobotSettings(rules=rules)), drops)
    twist = ["geometry_msgs/msg/Twist"]
    for _ in range(2):
        checked.look(
            [("/cmd_vel", twist), ("/good", [*twist, "no_such_msgs/msg/Thing"])], [("/set", ["std_srvs/srv/SetBool"])]
        )
    assert sorted(checked.wrong) == ["/cmd_vel", "/set"]
    assert drops["wrong_settings"] == 2
