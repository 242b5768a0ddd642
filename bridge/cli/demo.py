"""What ``macs up --demo`` shows: a headset that receives a robot's data and drives it, with numbers for a person."""

from __future__ import annotations

import asyncio
import math
import statistics
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from macs_zenoh.errors import MacsError, Unreachable
from macs_zenoh.timeouts import within

if TYPE_CHECKING:
    from bridge.headset.client import Headset
    from bridge.headset.nodes import Subscription
    from macs_zenoh.typed import Types

POSE = ("/pose", "geometry_msgs/PoseStamped")
CAMERA = ("/camera/image/compressed", "sensor_msgs/CompressedImage")
COMMANDS = ("/cmd_vel", "geometry_msgs/Twist")

PATIENCE_S = 20.0
"""For each step: ROS discovery takes a second or two, a loaded machine more."""
WATCH_S = 2.0
DRIVE_S = 2.0
COMMANDS_HZ = 10.0
FORWARD_M_S = 0.5
TURN_RAD_S = 0.4
MOVED_M = 0.2
"""A fifth of what the commands ask for is enough to say that the robot was driven."""

Say = Callable[[str], None]


async def show(host: str, port: int, robot: int, say: Say) -> bool:
    """Play the whole show against a gateway and say what came of it, in one block; False when a step failed."""
    from bridge.headset.client import Headset
    from macs_zenoh.typed import Types

    lines = ["", "A headset without hardware, over TCP, as a Unity headset would do it:", ""]
    try:
        async with await Headset.connect(host, port) as headset:
            lines.append(f"  connected    to {headset.target}; it is headset {headset.id} on the mesh")
            await _Show(headset, Types(), robot, lines.append).play()
        lines += ["", "All of it went headset -> TCP -> gateway -> Zenoh router -> robot agent -> ROS 2, or back."]
        return True
    except MacsError as error:
        lines += [f"  FAILED       {error}"]
        return False
    finally:
        say("\n".join(lines))


class _Show:
    """The steps; each raises a MacsError when it does not work within `PATIENCE_S`."""

    def __init__(self, headset: Headset, types: Types, robot: int, say: Say) -> None:
        self.headset = headset
        self.types = types
        self.robot = robot
        self.say = say

    async def play(self) -> None:
        await self.find_robot()
        await self.watch_camera()
        async with self.following_pose() as poses:
            await self.drive(poses)

    async def find_robot(self) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while self.robot not in (online := await self.headset.online()).ros_agent_ids:
            if time.monotonic() > deadline:
                raise Unreachable(f"robot {self.robot}", "it did not come online")
            await asyncio.sleep(0.2)
        self.say(f"  who is here  robots {online.ros_agent_ids}, headsets {online.unity_agent_ids}")

    async def watch_camera(self) -> None:
        camera = await self.headset.subscribe(*CAMERA, agents=[self.robot])
        sizes: list[int] = []
        kind = self.types.deserialize(CAMERA[1], (await _first(camera, CAMERA[0])).data, max_bytes=0)["format"]
        until = time.monotonic() + WATCH_S
        while (left_s := until - time.monotonic()) > 0:
            try:
                sizes.append(len((await within(camera.__anext__(), left_s)).data))
            except asyncio.TimeoutError:
                break
        if not sizes:
            raise Unreachable(CAMERA[0], "one picture came, and then no more")
        rate = len(sizes) / WATCH_S
        self.say(f"  camera       {len(sizes)} pictures ({kind}) in {WATCH_S:g} s: {rate:.0f} Hz, {_kb(sizes)} each")
        await camera.close()

    @asynccontextmanager
    async def following_pose(self) -> AsyncIterator[_Poses]:
        """Receive the pose in the background."""
        subscription = await self.headset.subscribe(*POSE, agents=[self.robot])
        poses = _Poses(self.types)
        poses.take((await _first(subscription, POSE[0])).data)
        task = asyncio.create_task(poses.follow(subscription))
        try:
            yield poses
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            await subscription.close()

    async def drive(self, poses: _Poses) -> None:
        start = poses.now
        twist = {"linear": {"x": FORWARD_M_S}, "angular": {"z": TURN_RAD_S}}
        commands = await self.headset.advertise(*COMMANDS, agents=[self.robot])
        sent = 0
        deadline = time.monotonic() + PATIENCE_S
        until = math.inf
        while time.monotonic() < min(until, deadline):
            await commands.publish(self.types.serialize(COMMANDS[1], twist), agents=[self.robot])
            sent += 1
            if until == math.inf and poses.now != start:  # it has begun to move: drive for so long from here on
                until = time.monotonic() + DRIVE_S
            await asyncio.sleep(1 / COMMANDS_HZ)
        await commands.publish(self.types.serialize(COMMANDS[1], {}), agents=[self.robot])
        await poses.standing()  # or it leaves before its last command has arrived
        moved_m = math.dist(start, poses.now)
        if moved_m < MOVED_M:
            raise Unreachable(COMMANDS[0], f"{sent} commands moved the robot by {moved_m:.2f} m only")
        self.say(
            f"  pose         {len(poses.ages_ms)} messages, "
            f"{statistics.median(poses.ages_ms):.1f} ms old when they arrive (median)"
        )
        self.say(f"  drive        {sent} commands on {COMMANDS[0]}: from {_place(start)} to {_place(poses.now)} m")


class _Poses:
    """The robot's last place, and how old each message was when it came."""

    def __init__(self, types: Types) -> None:
        self.types = types
        self.now = (0.0, 0.0)
        self.ages_ms: list[float] = []

    def take(self, cdr: bytes) -> None:
        message: dict[str, Any] = self.types.deserialize(POSE[1], cdr)
        stamp, position = message["header"]["stamp"], message["pose"]["position"]
        self.ages_ms.append((time.time() - stamp["sec"] - stamp["nanosec"] / 1e9) * 1000)
        self.now = (position["x"], position["y"])

    async def standing(self) -> None:
        """Wait until two poses are the same. Raises Unreachable when it goes on for ever."""
        deadline, before, count = time.monotonic() + PATIENCE_S, self.now, len(self.ages_ms)
        while time.monotonic() < deadline:
            await asyncio.sleep(1 / COMMANDS_HZ)
            if len(self.ages_ms) > count:
                if self.now == before:
                    return
                before, count = self.now, len(self.ages_ms)
        raise Unreachable(COMMANDS[0], "the robot does not stop when it is told to")

    async def follow(self, subscription: Subscription) -> None:
        async for message in subscription:
            self.take(message.data)


async def _first(subscription: Subscription, topic: str) -> Any:
    try:
        return await within(subscription.__anext__(), PATIENCE_S)
    except asyncio.TimeoutError:
        raise Unreachable(topic, f"nothing came within {PATIENCE_S:g} s") from None


def _kb(sizes: list[int]) -> str:
    return f"{statistics.mean(sizes) / 1000:.1f} kB"


def _place(point: tuple[float, float]) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"
