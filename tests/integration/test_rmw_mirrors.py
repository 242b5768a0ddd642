"""Robots that run rmw_zenoh in each other's graphs: transforms get a prefix, services answer, what is latched comes to
who joins later, and each sends one copy."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

from macs_zenoh import ros
from macs_zenoh.errors import Unreachable
from macs_zenoh.protocol.rmw_zenoh.cdr import read_text
from macs_zenoh.protocol.rmw_zenoh.keyexpr import Kind
from macs_zenoh.protocol.rmw_zenoh.qos import Durability, Qos
from tests.support.links import Link, counted
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
topics = ["/tf", "/pose", "/map"]
services = ["/lamp"]
tf_prefix = "robot{robot}/"
"""
EACH_OTHER = """
[rmw_zenoh]
connect = ["{router}"]

[[robot.mirror]]
from = "group/3"
topics = ["/pose"]
"""
TF, POSE, TEXT, LAMP = "tf2_msgs/TFMessage", "geometry_msgs/PoseStamped", "std_msgs/String", "std_srvs/SetBool"
LATCHED = Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)
HZ, POSE_BYTES = 50, 4000
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


async def test_who_joins_later_has_the_map_and_the_services(tmp_path: Path) -> None:
    """Robot 2 comes when robot 1 has said its map for good: a node of robot 2 has it, and so has one that comes later
    still; it calls a service of robot 1, and hears why there is no answer when robot 1 has gone."""
    settings = tmp_path / "robots.toml"
    settings.write_text(SETTINGS, encoding="utf-8")
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        router = await enter(Router())
        await enter(Program("rmw-zenoh", "--settings", str(settings), "-e", router.endpoint))
        robot = await enter(AsyncExitStack())
        other = await robot.enter_async_context(ros.node("base", domain=51, connect=[router.endpoint]))
        other.publisher("/map", TEXT, qos=LATCHED).publish({"data": "hall"})
        asked: list[bool] = []

        async def switch(request: dict[str, bool]) -> dict[str, object]:
            asked.append(request["data"])
            return {"success": request["data"], "message": "lamp"}

        other.serve("/lamp", LAMP, switch)
        own = await enter(ros.node("planner", domain=52, connect=[router.endpoint]))
        for name in ("first", "late"):
            node = own if name == "first" else await enter(ros.node(name, domain=52, connect=[router.endpoint]))
            maps = node.subscribe("/robot1/map", TEXT, qos=LATCHED)
            assert (await asyncio.wait_for(maps.receive(), PATIENCE_S)).value == {"data": "hall"}

        graph = own.network.graph(52)
        await until(lambda: graph.on("/robot1/lamp", Kind.SERVICE), PATIENCE_S)
        for on in (True, False):
            answer = await own.call("/robot1/lamp", LAMP, {"data": on}, timeout_s=PATIENCE_S)
            assert answer == {"success": on, "message": "lamp"}
        assert asked == [True, False]
        await robot.aclose()
        await until(lambda: not graph.on("/robot1/lamp", Kind.SERVICE), PATIENCE_S)
        await until(lambda: not graph.on("/robot1/map", Kind.PUBLISHER), PATIENCE_S)
        with pytest.raises(Unreachable, match="no such service"):
            await own.call("/robot1/lamp", LAMP, {"data": True}, timeout_s=0.1)


@pytest.mark.parametrize("seconds", [3, pytest.param(60, marks=pytest.mark.soak)])
async def test_each_robot_sends_one_copy(tmp_path: Path, seconds: int) -> None:
    """Three robots, each with a router of its own, with each other's poses at 50 Hz, of which two nodes on each robot
    have each: every pose comes once to each node, in order, goes up once, and comes down once from each of the others;
    nothing of what is mirrored goes on."""
    robots = range(1, 4)
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        mesh = await enter(Router())
        routers = {number: await enter(Router()) for number in robots}
        links: dict[int, Link] = {number: await enter(counted(mesh.endpoint)) for number in robots}
        for number in robots:
            settings = tmp_path / f"{number}.toml"
            settings.write_text(EACH_OTHER.format(router=routers[number].endpoint), encoding="utf-8")
            options = ("--id", str(number), "--group", "3", "--settings", str(settings))
            await enter(Program("rmw-zenoh", *options, "-e", links[number].endpoint))
        nodes = {
            number: [await enter(ros.node(name, connect=[routers[number].endpoint])) for name in ("base", "planner")]
            for number in robots
        }
        publishers = [nodes[number][0].publisher("/pose", TEXT) for number in robots]
        heard = {
            (here, there, at): node.subscribe(f"/robot{there}/pose", TEXT)
            for here in robots
            for there in robots
            if here != there
            for at, node in enumerate(nodes[here])
        }
        said: dict[tuple[int, int, int], list[str]] = {key: [] for key in heard}

        def take() -> None:
            for key, subscription in heard.items():
                while subscription._waiting:
                    said[key].append(read_text(subscription._waiting.popleft().data).decode().split()[0])

        def all_have(word: str) -> bool:
            for publisher in publishers:
                publisher.publish({"data": word})
            take()
            return all(word in words for words in said.values())

        await until(lambda: all_have("begin"), PATIENCE_S, every_s=0.05)
        before = {number: (link.up_bytes, link.down_bytes) for number, link in links.items()}
        for number in range(HZ * seconds):
            for publisher in publishers:
                publisher.publish({"data": f"{number} ".ljust(POSE_BYTES, "x")})
            await asyncio.sleep(1 / HZ)
            take()
        await until(lambda: all_have("end"), PATIENCE_S, every_s=0.05)
        for words in said.values():
            numbers = [int(word) for word in words if word.isdigit()]
            assert numbers == sorted(set(numbers))  # a busy machine may lose some
            assert len(numbers) > HZ * seconds / 2
        for number, link in links.items():
            up, down = (
                (now - was) / (HZ * seconds * POSE_BYTES)
                for now, was in zip((link.up_bytes, link.down_bytes), before[number], strict=True)
            )
            assert 0.5 < up < 1.5
            assert 1 < down < 2.7
        for number, (node, _) in nodes.items():
            topics = {topic for topic, _ in node.network.graph(0).names_and_types() if topic.endswith("pose")}
            assert topics == {"/pose", *(f"/robot{there}/pose" for there in robots if there != number)}
