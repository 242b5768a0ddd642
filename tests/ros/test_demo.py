"""The demo robot, as arithmetic and as a process."""

from __future__ import annotations

import asyncio
import math
import os
import signal
import struct
import sys
import zlib
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Twist
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, JointState, LaserScan, PointCloud2
from std_srvs.srv import SetBool

from bridge.ros import demo_senses, graph
from bridge.ros.demo import Battery, Unicycle
from bridge.ros.demo_scene import PILLARS, Scene
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, get


def test_a_unicycle_drives_a_circle() -> None:
    """At 1 m/s and 1 rad/s it is back where it began after 2 pi seconds."""
    robot = Unicycle()
    robot.move(0.0)
    for step in range(1000):
        robot.command(1.0, 1.0, step * 2 * math.pi / 1000)
        robot.move((step + 1) * 2 * math.pi / 1000)
    assert (robot.x, robot.y, robot.heading) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


def test_a_unicycle_stops_when_commands_stop() -> None:
    """Half a second after the last command it stands."""
    robot = Unicycle()
    robot.move(10.0)
    robot.command(1.0, 0.0, 10.0)
    for now in (10.25, 10.5, 10.75, 11.0, 60.0):
        robot.move(now)
    assert not robot.moving
    assert robot.x == pytest.approx(0.75)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_command_that_is_no_number_is_a_stop(number: float) -> None:
    """Nonsense does not put the robot nowhere."""
    robot = Unicycle()
    robot.command(number, 0.0, 0.0)
    robot.move(0.1)
    assert (robot.moving, robot.x) == (False, 0.0)


@pytest.mark.parametrize("lights", [True, False])
def test_the_picture_is_a_png(lights: bool) -> None:
    """Every chunk has its checksum, and the pixels are as many as the header says."""
    robot = Unicycle()
    robot.x, robot.y, robot.heading = 3.3, -7.7, 2.0
    scene = Scene()
    chunks = dict(_chunks(scene.png(robot, lights=lights)))
    width, height = struct.unpack(">II", chunks[b"IHDR"][:8])
    rows = zlib.decompress(chunks[b"IDAT"])
    assert list(chunks) == [b"IHDR", b"PLTE", b"IDAT", b"IEND"]
    assert len(rows) == height * (1 + width)
    assert max(rows) < len(chunks[b"PLTE"]) // 3 <= 256
    assert chunks[b"PLTE"] == scene.palette(lights=lights) != scene.palette(lights=not lights)


def test_the_picture_is_another_one_elsewhere() -> None:
    """What it shows moves when the robot does, and what is near is nearer in the picture of depth."""
    robot, scene = Unicycle(), Scene()
    before, far = scene.pixels(robot), scene.depth_mm(robot, 2)
    robot.x = 2.0  # towards the pillars
    assert (scene.pixels(robot) != before).mean() > 0.05
    near = scene.depth_mm(robot, 2)
    assert near.shape == (Scene.HEIGHT // 2, Scene.WIDTH // 2)
    assert near[near > 0].min() <= far[far > 0].min()


def test_a_battery_drains_sooner_while_it_drives() -> None:
    """In ten minutes a few hundredths, four times as many while driving, and never to nothing."""
    used = []
    for driving in (False, True):
        battery = Battery()
        for minute in range(11):
            battery.drain(minute * 60.0, driving=driving)
        used.append(0.93 - battery.charge)
    assert 0.02 < used[0] < used[1] < 0.2
    battery.drain(1e9, driving=True)
    assert battery.charge == 0.05


def _chunks(png: bytes) -> list[tuple[bytes, bytes]]:
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    found, at = [], 8
    while at < len(png):
        size, kind = struct.unpack_from(">I4s", png, at)
        data = png[at + 8 : at + 8 + size]
        assert struct.unpack_from(">I", png, at + 8 + size)[0] == zlib.crc32(kind + data)
        found.append((kind, data))
        at += 12 + size
    return found


@pytest.fixture
async def demo(domain: int) -> AsyncIterator[asyncio.subprocess.Process]:
    """The demo robot in its own process."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "bridge.ros.demo", env={**os.environ, "ROS_DOMAIN_ID": str(domain)}
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
async def test_the_demo_robot_shows_drives_and_ends(
    demo: asyncio.subprocess.Process, peer: Peer, end: signal.Signals
) -> None:
    """It publishes pictures and poses, moves when driven, switches its lights, and ends cleanly on a signal."""
    poses = await peer.subscription(PoseStamped, "/pose")
    pictures = await peer.subscription(CompressedImage, "/camera/image/compressed", qos_profile_sensor_data)
    commands = await peer.publisher(Twist, "/cmd_vel", matched=1)
    picture = await get(pictures)
    assert picture.format == "png"
    assert _chunks(bytes(picture.data))
    twist = Twist()
    twist.linear.x = 1.0
    while (await get(poses)).pose.position.x < 0.05:
        commands.publish(twist)
    assert (await _call(peer, SetBool, "/set_lights", SetBool.Request(data=True))).message == "lights on"
    offered = await peer.session.run(lambda: graph.offers(peer.session))
    assert offered.subscribers == {"/cmd_vel": "geometry_msgs/msg/Twist"}
    offered.publishers.pop("/tf", None)  # tf2_msgs is not on PyPI
    assert offered.publishers == {
        "/battery": "sensor_msgs/msg/BatteryState",
        "/camera/depth": "sensor_msgs/msg/Image",
        "/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
        "/joint_states": "sensor_msgs/msg/JointState",
        "/map": "nav_msgs/msg/OccupancyGrid",
        "/points": "sensor_msgs/msg/PointCloud2",
        "/pose": "geometry_msgs/msg/PoseStamped",
        "/scan": "sensor_msgs/msg/LaserScan",
        "/turret/pose": "geometry_msgs/msg/PoseStamped",
    }
    assert offered.services == {"/set_lights": "std_srvs/srv/SetBool"}
    demo.send_signal(end)
    assert await asyncio.wait_for(demo.wait(), PATIENCE_S) == 0


async def _call(peer: Peer, kind: type[Any], name: str, request: Any) -> Any:
    node = peer.session.node
    answered: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
    loop = asyncio.get_running_loop()

    def ask() -> None:
        client = node.create_client(kind, name)
        assert client.wait_for_service(timeout_sec=5)
        future = client.call_async(request)
        future.add_done_callback(lambda done: loop.call_soon_threadsafe(answered.set_result, done.result()))

    await peer.session.run(ask)
    return await asyncio.wait_for(answered, PATIENCE_S)


def test_what_its_laser_measures_is_where_pillars_are() -> None:
    """From anywhere each ray ends on the edge of a pillar or nowhere, and so do the points."""
    robot = Unicycle()
    for robot.x, robot.y, robot.heading in ((0.0, 0.0, 0.0), (4.0, -2.0, 1.0), (-7.0, 5.0, -2.5)):
        distance, which = demo_senses.scan(robot)
        for number in np.flatnonzero(np.isfinite(distance)):
            angle = robot.heading + demo_senses.FIRST_RAD + number * demo_senses.STEP_RAD
            at = robot.x + distance[number] * math.cos(angle), robot.y + distance[number] * math.sin(angle)
            pillar = PILLARS[which[number]]
            assert math.dist(at, (pillar.x, pillar.y)) == pytest.approx(pillar.radius, abs=1e-3)
        points = demo_senses.points(robot)
        assert 20 < len(points) < 2000
        assert np.isfinite(points[:, :3]).all()


def test_wheels_turn_as_it_drives() -> None:
    """A metre ahead is ten turns of a wheel's radius; turning to the left the right one goes ahead."""
    wheels = demo_senses.Wheels()
    wheels.roll(1.0, 0.0, 1.0)
    assert (wheels.left, wheels.right) == pytest.approx((10.0, 10.0))
    wheels.roll(0.0, 1.0, 1.0)
    assert wheels.right - wheels.left == pytest.approx(5.0)


async def test_it_shows_more_than_pictures(demo: Any, peer: Peer) -> None:
    """Scan, points and joints, each as programs that draw them expect."""
    scan = await get(await peer.subscription(LaserScan, "/scan", qos_profile_sensor_data))
    assert len(scan.ranges) == demo_senses.RAYS
    assert scan.angle_min + scan.angle_increment * (len(scan.ranges) - 1) == pytest.approx(scan.angle_max, abs=1e-4)
    cloud = await get(await peer.subscription(PointCloud2, "/points", qos_profile_sensor_data))
    assert len(cloud.data) == cloud.row_step == cloud.width * cloud.point_step
    joints = await get(await peer.subscription(JointState, "/joint_states"))
    assert len(joints.name) == len(joints.position) == 3
