"""Topics of the demo robot that show what `demo_senses` measures, for programs that draw more than a picture."""

from __future__ import annotations

import array
import contextlib
import math
from collections.abc import Callable
from typing import Any, Protocol

from geometry_msgs.msg import TransformStamped
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState, LaserScan, PointCloud2, PointField

from bridge.ros import demo_senses as senses
from bridge.ros.demo_scene import Place

SCAN_HZ, POINTS_HZ, JOINTS_HZ = 5.0, 2.0, 10.0


class Driven(Place, Protocol):
    """Where the robot is, and how it moves."""

    forward: float
    turn: float


class Senses:
    """Publishes ``/scan`` (sensor_msgs/LaserScan), ``/points`` (sensor_msgs/PointCloud2), ``/joint_states``
    (sensor_msgs/JointState), and ``/tf`` where tf2_msgs is installed; each only while somebody takes it."""

    def __init__(self, node: Any, robot: Driven, turret: Callable[[], float]) -> None:
        self._node = node
        self._robot = robot
        self._turret = turret
        self._wheels = senses.Wheels()
        self._scan = node.create_publisher(LaserScan, "/scan", qos_profile_sensor_data)
        self._points = node.create_publisher(PointCloud2, "/points", qos_profile_sensor_data)
        self._joints = node.create_publisher(JointState, "/joint_states", 10)
        self._tf: Any = None
        with contextlib.suppress(ImportError):  # it is in every ROS, and not on PyPI
            from tf2_msgs.msg import TFMessage

            self._message = TFMessage
            self._tf = node.create_publisher(TFMessage, "/tf", 10)
        for hz, publish in ((SCAN_HZ, self._publish_scan), (POINTS_HZ, self._publish_points)):
            node.create_timer(1 / hz, publish)
        node.create_timer(1 / JOINTS_HZ, self._publish_joints)

    def _stamp(self, message: Any, frame: str) -> Any:
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = frame
        return message

    def _publish_scan(self) -> None:
        if not self._scan.get_subscription_count():
            return
        message = self._stamp(LaserScan(), "base_link")
        message.angle_min, message.angle_increment = senses.FIRST_RAD, senses.STEP_RAD
        message.angle_max = senses.FIRST_RAD + senses.STEP_RAD * (senses.RAYS - 1)
        message.scan_time = 1 / SCAN_HZ
        message.range_min, message.range_max = 0.05, senses.RANGE_M
        message.ranges = array.array("f", senses.scan(self._robot)[0].tobytes())
        self._scan.publish(message)

    def _publish_points(self) -> None:
        if not self._points.get_subscription_count():
            return
        rows = senses.points(self._robot)
        message = self._stamp(PointCloud2(), "base_link")
        message.height, message.width = 1, len(rows)
        message.fields = [
            PointField(name=name, offset=4 * number, datatype=PointField.FLOAT32, count=1)
            for number, name in enumerate(("x", "y", "z", "rgb"))
        ]
        message.point_step, message.row_step = 16, 16 * len(rows)
        message.data = array.array("B", rows.tobytes())
        message.is_dense = True
        self._points.publish(message)

    def _publish_joints(self) -> None:
        self._wheels.roll(self._robot.forward, self._robot.turn, 1 / JOINTS_HZ)
        if self._joints.get_subscription_count():
            message = self._stamp(JointState(), "")
            message.name = ["wheel_left", "wheel_right", "turret"]
            message.position = [self._wheels.left, self._wheels.right, self._turret()]
            self._joints.publish(message)
        if self._tf is not None and self._tf.get_subscription_count():
            robot, turret = self._robot, self._turret()
            self._tf.publish(
                self._message(
                    transforms=[
                        self._transform("map", "base_link", robot.x, robot.y, 0.0, robot.heading),
                        self._transform("base_link", "camera", 0.2, 0.0, 0.55, 0.0),
                        self._transform("base_link", "turret", 0.0, 0.0, 0.8, turret),
                    ]
                )
            )

    def _transform(self, parent: str, child: str, x: float, y: float, z: float, yaw: float) -> Any:
        message = self._stamp(TransformStamped(child_frame_id=child), parent)
        where, turned = message.transform.translation, message.transform.rotation
        where.x, where.y, where.z = x, y, z
        turned.z, turned.w = math.sin(yaw / 2), math.cos(yaw / 2)
        return message
