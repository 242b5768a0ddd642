"""A camera of a robot in a process of its own: ``python -m tests.page.camera FOLDER HZ RAW_HZ``.

Publishes the JPEG files of the folder in turn on /test/jpeg and /test/jpeg2, and raw pictures of 0.9 MB on /test/raw.
"""

from __future__ import annotations

import array
import sys
from pathlib import Path

import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image

from bridge.cli.running import say_ready


def main() -> int:
    """Until it is killed."""
    folder, hz, raw_hz = Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
    files = [array.array("B", path.read_bytes()) for path in sorted(folder.glob("*.jpg"))]
    rclpy.init()
    node = rclpy.create_node("camera")
    one, two = (
        node.create_publisher(CompressedImage, topic, qos_profile_sensor_data)
        for topic in ("/test/jpeg", "/test/jpeg2")
    )
    raw = node.create_publisher(Image, "/test/raw", qos_profile_sensor_data)
    picture = CompressedImage()
    picture.format = "jpeg"
    large = Image(height=480, width=640, encoding="rgb8", step=640 * 3)
    large.data = array.array("B", bytes(640 * 480 * 3))
    turn = 0

    def publish() -> None:
        nonlocal turn
        turn += 1
        picture.data = files[turn % len(files)]
        picture.header.stamp = node.get_clock().now().to_msg()
        one.publish(picture)
        two.publish(picture)

    def publish_raw() -> None:
        large.header.stamp = node.get_clock().now().to_msg()
        raw.publish(large)

    if hz:
        node.create_timer(1 / hz, publish)
    if raw_hz:
        node.create_timer(1 / raw_hz, publish_raw)
    say_ready("camera")
    rclpy.spin(node)
    return 0


if __name__ == "__main__":
    sys.exit(main())
