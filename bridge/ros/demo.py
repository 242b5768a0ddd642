"""A robot to try things with: ``python -m bridge.ros.demo`` is one ROS 2 node, in a process of its own.

Publishes a generated camera picture on ``/camera/image/compressed`` (sensor_msgs/CompressedImage, 10 Hz, best effort
as cameras are), how far away what it shows is on ``/camera/depth`` (sensor_msgs/Image, 5 Hz), where it is on ``/pose``
(geometry_msgs/PoseStamped, 20 Hz), a turret that swings on ``/turret/pose``, its ``/battery``
(sensor_msgs/BatteryState), and once, for all who come, the ``/map`` of its floor (nav_msgs/OccupancyGrid); while
somebody takes them, what a laser and its joints show (`demo_topics`). Drives as ``/cmd_vel`` (geometry_msgs/Twist)
says, and stops half a second after the last command. Serves ``/set_lights`` (std_srvs/SetBool), which the picture
shows.
"""

from __future__ import annotations

import array
import logging
import math
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import OccupancyGrid
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, CompressedImage, Image
from std_srvs.srv import SetBool

from bridge.logs import log_to_stderr
from bridge.ros.demo_scene import CELL_M, MAP_M, Scene, floor_map
from bridge.ros.demo_topics import Senses
from bridge.ros.session import why

log = logging.getLogger("macs.demo")

IMAGE_HZ = 10.0
DEPTH_HZ = 5.0
DEPTH_EVERY = 2
"""Of the pixels of a picture, which are those of the one of depth."""
TURRET_HZ = 10.0
BATTERY_HZ = 1.0
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


class Battery:
    """It lasts two hours, one of which is driven. Pure: the time is passed in. Volts, amperes, 0 to 1."""

    IDLE_A, DRIVING_A, CAPACITY_AH = 1.0, 4.0, 5.0

    def __init__(self) -> None:
        self.charge = 0.93
        self.current = self.IDLE_A
        self._at: float | None = None

    @property
    def volts(self) -> float:
        """The less there is in it, the less."""
        return 21.0 + 4.2 * self.charge - 0.05 * self.current

    def drain(self, now: float, *, driving: bool) -> None:
        """What was used since it was called last."""
        if self._at is not None:
            self.charge = max(0.05, self.charge - self.current * (now - self._at) / 3600 / self.CAPACITY_AH)
        self._at = now
        self.current = self.DRIVING_A if driving else self.IDLE_A


class DemoRobot:
    """The ROS node around a `Unicycle`, what it sees, and its `Battery`."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._robot = Unicycle()
        self._scene = Scene()
        self._battery = Battery()
        self._lights = False
        self._driven = False
        self._pose = node.create_publisher(PoseStamped, "/pose", 10)
        self._image = node.create_publisher(CompressedImage, "/camera/image/compressed", qos_profile_sensor_data)
        self._depth = node.create_publisher(Image, "/camera/depth", qos_profile_sensor_data)
        self._turret = node.create_publisher(PoseStamped, "/turret/pose", 10)
        self._power = node.create_publisher(BatteryState, "/battery", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._map = node.create_publisher(OccupancyGrid, "/map", latched)
        self._map.publish(self._drawn_map())
        node.create_subscription(Twist, COMMANDS, self._drive, 10)
        node.create_service(SetBool, "/set_lights", self._set_lights)
        node.create_timer(1 / POSE_HZ, self._publish_pose)
        node.create_timer(1 / IMAGE_HZ, self._publish_image)
        node.create_timer(1 / DEPTH_HZ, self._publish_depth)
        node.create_timer(1 / TURRET_HZ, self._publish_turret)
        node.create_timer(1 / BATTERY_HZ, self._publish_battery)
        self._senses = Senses(node, self._robot, self._turret_angle)

    def _now_s(self) -> float:
        return float(self._node.get_clock().now().nanoseconds) / 1e9

    def _turret_angle(self) -> float:
        return math.sin(self._now_s() / 2)

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
        message.data = array.array("B", self._scene.png(self._robot, lights=self._lights))
        self._image.publish(message)

    def _publish_depth(self) -> None:
        depth = self._scene.depth_mm(self._robot, DEPTH_EVERY)
        message = Image()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = "camera"
        message.height, message.width = depth.shape
        message.encoding = "16UC1"
        message.is_bigendian = int(sys.byteorder == "big")
        message.step = depth.shape[1] * depth.itemsize
        message.data = array.array("B", depth.tobytes())
        self._depth.publish(message)

    def _drawn_map(self) -> Any:
        cells = floor_map()
        message = OccupancyGrid()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = "map"
        message.info.map_load_time = message.header.stamp
        message.info.resolution = CELL_M
        message.info.height, message.info.width = cells.shape
        message.info.origin.position.x = message.info.origin.position.y = -MAP_M / 2
        message.info.origin.orientation.w = 1.0
        message.data = array.array("b", cells.tobytes())
        return message

    def _publish_turret(self) -> None:
        angle = self._turret_angle()
        message = PoseStamped()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = "base_link"
        message.pose.position.z = 0.8
        message.pose.orientation.z = math.sin(angle / 2)
        message.pose.orientation.w = math.cos(angle / 2)
        self._turret.publish(message)

    def _publish_battery(self) -> None:
        self._battery.drain(self._now_s(), driving=self._robot.moving)
        message = BatteryState()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.voltage = self._battery.volts
        message.current = -self._battery.current
        message.percentage = self._battery.charge
        message.capacity = Battery.CAPACITY_AH
        message.present = True
        message.power_supply_status = BatteryState.POWER_SUPPLY_STATUS_DISCHARGING
        self._power.publish(message)


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
    log.info(
        "demo robot: pictures on /camera/…, /pose, /scan, /points, /map, /battery; driven on /cmd_vel; /set_lights"
    )
    rclpy.spin(node)
    return 0


if __name__ == "__main__":
    sys.exit(main())
