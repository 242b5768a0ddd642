"""A sensor: ``python -m tests.ros.imu HZ`` publishes /imu (sensor_msgs/Imu) until its input ends. Then it prints
how often it did, by its own count and clock."""

from __future__ import annotations

import sys
import threading
import time

import rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu


def main() -> None:
    """Publish until standard input ends."""
    period_s = 1 / float(sys.argv[1])
    rclpy.init()
    node = rclpy.create_node("imu")
    publisher = node.create_publisher(Imu, "/imu", QoSProfile(depth=1000))
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    message = Imu()
    began = last = time.monotonic()
    sent = 0
    while not ended.is_set():
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)
        last = time.monotonic()
        sent += 1
        time.sleep(max(0.0, began + sent * period_s - time.monotonic()))
    print((sent - 1) / (last - began), flush=True)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
