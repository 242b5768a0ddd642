"""Robots that run rmw_zenoh in each other's graphs: transforms get a prefix."""

from __future__ import annotations

from contextlib import AsyncExitStack
from pathlib import Path

import pytest

from macs_zenoh import ros
from tests.support.programs import Program
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)

SETTINGS = """
[[rmw_zenoh.robots]]
id = 1
domain = 51

[[rmw_zenoh.robots]]
id = 2
domain = 52

[[robot.mirror]]
from = "ros/1"
topics = ["/tf", "/pose"]
tf_prefix = "robot{robot}/"
"""
TF, POSE = "tf2_msgs/TFMessage", "geometry_msgs/PoseStamped"
SAID = {
    "transforms": [
        {
            "header": {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "odom"},
            "child_frame_id": "base",
            "transform": {"translation": {"x": 2.5}, "rotation": {"w": 1.0}},
        },
        {"header": {"frame_id": "/base"}, "child_frame_id": "/arm"},
    ]
}


async def test_transforms_get_a_prefix(tmp_path: Path) -> None:
    """Each frame of another robot's transforms has the name that the rule says, and nothing else is changed; frames in
    messages of other types stay."""
    settings = tmp_path / "robots.toml"
    settings.write_text(SETTINGS, encoding="utf-8")
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        router = await enter(Router())
        await enter(Program("rmw-zenoh", "--settings", str(settings), "-e", router.endpoint))
        other = await enter(ros.node("base", domain=51, connect=[router.endpoint]))
        own = await enter(ros.node("planner", domain=52, connect=[router.endpoint]))
        says, poses = other.publisher("/tf", TF), other.publisher("/pose", POSE)
        transforms, plain = own.subscribe("/robot1/tf", TF), own.subscribe("/robot1/pose", POSE)

        def comes() -> bool:
            says.publish(SAID)
            poses.publish({"header": {"frame_id": "odom"}})
            return bool(transforms._waiting and plain._waiting)

        await until(comes, PATIENCE_S, every_s=0.05)
        first, second = (await transforms.receive()).value["transforms"]
        assert (first["header"]["frame_id"], first["child_frame_id"]) == ("robot1/odom", "robot1/base")
        assert (second["header"]["frame_id"], second["child_frame_id"]) == ("robot1/base", "robot1/arm")
        assert first["header"]["stamp"] == {"sec": 7, "nanosec": 8}
        assert (first["transform"]["translation"]["x"], first["transform"]["rotation"]["w"]) == (2.5, 1.0)
        assert (await plain.receive()).value["header"]["frame_id"] == "odom"
