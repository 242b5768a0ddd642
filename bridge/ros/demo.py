"""A robot to try things with: ``python -m bridge.ros.demo`` is one ROS 2 node, in a process of its own.

Publishes a generated camera picture on ``/camera/image/compressed`` (sensor_msgs/CompressedImage, 10 Hz, best effort
as cameras are) and where it is on ``/pose`` (geometry_msgs/PoseStamped, 20 Hz). Drives as ``/cmd_vel``
(geometry_msgs/Twist) says, and stops half a second after the last command. Serves ``/set_lights`` (std_srvs/SetBool),
which the picture shows.
"""

from __future__ import annotations

import array
import logging
import math
import struct
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, Twist
from rclpy.executors import ExternalShutdownException
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage
from std_srvs.srv import SetBool

from bridge.logs import log_to_stderr
from bridge.ros.session import why

log = logging.getLogger("macs.demo")

IMAGE_HZ = 10.0
POSE_HZ = 20.0
COMMAND_TIMEOUT_S = 0.5
COMMANDS = "/cmd_vel"
DISCOVERY_S = 1.0
"""How long nodes of one domain take to find each other, at most; on one machine a third of that."""


class Unicycle:
    """A robot that drives forward and turns. Pure: the time is passed in. Metres, radians, seconds."""

    def __init__(self) -> None:
        self.x = self.y = self.heading = 0.0
        self.forward = self.turn = 0.0
        self._commanded_at = -math.inf
        self._moved_at: float | None = None

    @property
    def moving(self) -> bool:
        """Whether a command that is not zero holds."""
        return bool(self.forward or self.turn)

    def command(self, forward: float, turn: float, now: float) -> None:
        """Drive with ``forward`` m/s and ``turn`` rad/s from now on. What is not a number counts as a stop."""
        self.forward, self.turn = (forward, turn) if math.isfinite(forward + turn) else (0.0, 0.0)
        self._commanded_at = now

    def move(self, now: float) -> None:
        """Be where the commands have led by now; stop when the last one is too old."""
        if self._moved_at is not None:
            dt = now - self._moved_at
            middle = self.heading + self.turn * dt / 2
            self.x += self.forward * dt * math.cos(middle)
            self.y += self.forward * dt * math.sin(middle)
            self.heading = math.remainder(self.heading + self.turn * dt, 2 * math.pi)
        self._moved_at = now
        if now - self._commanded_at > COMMAND_TIMEOUT_S:
            self.forward = self.turn = 0.0


class Camera:
    """Draws what the robot "sees": a floor that scrolls as it drives, itself in the middle. Pure."""

    WIDTH, HEIGHT = 160, 120
    TILE = 20
    FLOOR, LINE, BODY, NOSE = range(4)
    DAY = bytes((60, 70, 80, 110, 120, 130, 230, 120, 40, 255, 255, 255))
    LIT = bytes((160, 160, 120, 220, 220, 180, 230, 120, 40, 255, 255, 255))

    def png(self, robot: Unicycle, *, lights: bool) -> bytes:
        """One picture as a PNG file of about 1 KB (8 bit palette; PNG specification, sections 5 and 11)."""
        header = struct.pack(">IIBBBBB", self.WIDTH, self.HEIGHT, 8, 3, 0, 0, 0)
        palette = self.LIT if lights else self.DAY
        return b"".join(
            (
                b"\x89PNG\r\n\x1a\n",
                _chunk(b"IHDR", header),
                _chunk(b"PLTE", palette),
                _chunk(b"IDAT", zlib.compress(self._rows(robot), 1)),
                _chunk(b"IEND", b""),
            )
        )

    def _rows(self, robot: Unicycle) -> bytes:
        """The pixels, each row after a 0 that says "no filter"."""
        across, down = int(robot.x * 50), int(-robot.y * 50)
        tiles = bytes(self.LINE if (column + across) % self.TILE == 0 else self.FLOOR for column in range(self.WIDTH))
        line = bytes((self.LINE,)) * self.WIDTH
        rows = [bytearray(line if (row + down) % self.TILE == 0 else tiles) for row in range(self.HEIGHT)]
        self._dot(rows, 0, 0, 6, self.BODY)
        self._dot(rows, 8 * math.cos(robot.heading), -8 * math.sin(robot.heading), 3, self.NOSE)
        return b"".join(b"\x00" + row for row in rows)

    def _dot(self, rows: list[bytearray], right: float, below: float, radius: int, colour: int) -> None:
        centre_x, centre_y = self.WIDTH // 2 + round(right), self.HEIGHT // 2 + round(below)
        for dy in range(-radius, radius + 1):
            half = math.isqrt(radius * radius - dy * dy)
            rows[centre_y + dy][centre_x - half : centre_x + half + 1] = bytes((colour,)) * (2 * half + 1)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


class DemoRobot:
    """The ROS node around a `Unicycle` and its `Camera`."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._robot = Unicycle()
        self._camera = Camera()
        self._lights = False
        self._driven = False
        self._pose = node.create_publisher(PoseStamped, "/pose", 10)
        self._image = node.create_publisher(CompressedImage, "/camera/image/compressed", qos_profile_sensor_data)
        node.create_subscription(Twist, COMMANDS, self._drive, 10)
        node.create_service(SetBool, "/set_lights", self._set_lights)
        node.create_timer(1 / POSE_HZ, self._publish_pose)
        node.create_timer(1 / IMAGE_HZ, self._publish_image)

    def _now_s(self) -> float:
        return float(self._node.get_clock().now().nanoseconds) / 1e9

    def _drive(self, twist: Any) -> None:
        self._robot.move(self._now_s())
        self._robot.command(twist.linear.x, twist.angular.z, self._now_s())
        self._tell()

    def _tell(self) -> None:
        """Log when driving begins and ends, not every command."""
        robot = self._robot
        if robot.moving and not self._driven:
            log.info("driven: %.2f m/s forward, %.2f rad/s left", robot.forward, robot.turn)
        elif self._driven and not robot.moving:
            log.info("stopped at x %.2f m, y %.2f m", robot.x, robot.y)
        self._driven = robot.moving

    def _set_lights(self, request: Any, response: Any) -> Any:
        self._lights = request.data
        response.success = True
        response.message = f"lights {'on' if self._lights else 'off'}"
        log.info("%s", response.message)
        return response

    def _publish_pose(self) -> None:
        self._robot.move(self._now_s())
        self._tell()
        message = PoseStamped()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = "map"
        message.pose.position.x = self._robot.x
        message.pose.position.y = self._robot.y
        message.pose.orientation.z = math.sin(self._robot.heading / 2)
        message.pose.orientation.w = math.cos(self._robot.heading / 2)
        self._pose.publish(message)

    def _publish_image(self) -> None:
        message = CompressedImage()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = "camera"
        message.format = "png"
        # an array of bytes is taken as it is; of anything else rclpy checks every element
        message.data = array.array("B", self._camera.png(self._robot, lights=self._lights))
        self._image.publish(message)


def _others(node: Any) -> int:
    """How many nodes beside ours take the commands that are meant for us, once they had time to be found."""
    others, until = 0, time.monotonic() + DISCOVERY_S
    while not others and time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.1)
        others = node.count_subscribers(COMMANDS) - 1
    return others


def main(
    args: Sequence[str] | None = None, *, alone: bool = False, on_ready: Callable[[], None] = lambda: None
) -> int:
    """Run the demo robot until SIGINT or SIGTERM. ``args`` may hold ROS arguments (``--ros-args ...``).

    ``alone``: for who will be driven without anybody looking: 1 when another node of this domain would drive, too.
    """
    log_to_stderr()
    log.setLevel(logging.INFO)
    node = None
    try:
        rclpy.init(args=list(args) if args is not None else sys.argv)
        node = rclpy.create_node("demo_robot")
        return _run(node, alone=alone, on_ready=on_ready)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except RuntimeError as error:
        if node is None:
            log.error("ROS 2 cannot be reached: %s", why(error))
            return 1
        if rclpy.ok():
            raise
        return 0  # a call into ROS in the moment in which a signal ended it
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _run(node: Any, *, alone: bool, on_ready: Callable[[], None]) -> int:
    DemoRobot(node)
    if alone and _others(node):
        log.error("another node of this ROS domain takes %s: it would drive, too", COMMANDS)
        return 1
    on_ready()
    log.info("demo robot: picture on /camera/image/compressed, /pose; drive it on /cmd_vel; service /set_lights")
    rclpy.spin(node)
    return 0


if __name__ == "__main__":
    sys.exit(main())
