"""A ROS node that is told things with a stamp: ``python -m tests.page.lateness TOPIC=NAME_OF_GEOMETRY_MSGS …``.

For each message a line: the topic, how old it was when its callback was called, and when the middleware had it, in ms.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import rclpy
from geometry_msgs import msg
from rclpy.signals import SignalHandlerOptions

from bridge.cli.running import say_ready


def main() -> int:
    """Until it is killed."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # with rclpy's it sometimes does not end
    node = rclpy.create_node("lateness")

    def listen(topic: str, kind: str) -> None:
        def take(message: Any, info: Any) -> None:
            now = time.time_ns()
            stamp = message.header.stamp
            made = stamp.sec * 1_000_000_000 + stamp.nanosec
            print(topic, (now - made) / 1e6, (info["received_timestamp"] - made) / 1e6, flush=True)

        node.create_subscription(getattr(msg, kind), topic, take, 1000)

    for argument in sys.argv[1:]:
        listen(*argument.split("="))
    say_ready("lateness")
    rclpy.spin(node)
    return 0


if __name__ == "__main__":
    sys.exit(main())
