"""The hops from a headset to a ROS topic with nothing in them but Zenoh, with its threads as we have them, and rclpy.

``python -m benchmarks.bare gateway PORT SIZE`` puts on the mesh what it receives from one socket, so many bytes each;
``... robot PORT TOPIC`` publishes what comes from there; ``... headset PORT`` sends. PORT is the router's, for the
headset the bare gateway's.
"""

from __future__ import annotations

import socket
import sys
import threading
import time
from typing import Any

import zenoh

from macs_zenoh.mesh.threads import keep_attached, shared_threads

from .raw import RawZenoh
from .robot_ends import pace, stamped
from .worker import serve

KEY = "bench/bare"


def gateway(raw: RawZenoh, size: int) -> None:
    """One socket, read by a thread that waits for it."""
    publisher = raw.session.declare_publisher(KEY, express=True)
    server = socket.create_server(("127.0.0.1", 0))

    def work() -> None:
        connection, _ = server.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while received := connection.recv(size, socket.MSG_WAITALL):
            publisher.put(received)

    threading.Thread(target=work, daemon=True).start()
    serve({"port": server.getsockname()[1]}, {})


def robot(raw: RawZenoh, topic: str) -> None:
    """Published in the thread of Zenoh's that brings it."""
    import rclpy
    from std_msgs.msg import UInt8MultiArray

    rclpy.init()
    publisher = rclpy.create_node("bare").create_publisher(UInt8MultiArray, topic, 1000)

    def take(sample: zenoh.Sample) -> None:
        keep_attached()
        publisher.publish(sample.payload.to_bytes())

    raw.declare(KEY, take, direct=True)
    serve({}, {})


class Headset:
    """A socket whose frames are the data itself."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def publish(self, topic: str, size: int, hz: float, count: int) -> dict[str, Any]:
        """Send at a rate."""
        began = time.monotonic()
        pace(count, hz, self._socket.sendall, stamped(size))
        return {"took_s": time.monotonic() - began}


def main() -> None:
    """Run the worker."""
    role, port = sys.argv[1], int(sys.argv[2])
    if role == "headset":
        serve({}, {"publish": Headset(port).publish})
        return
    with shared_threads("client"):
        raw = RawZenoh(port)
    if role == "gateway":
        gateway(raw, int(sys.argv[3]))
    else:
        robot(raw, sys.argv[3])
    raw.session.close()  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    main()
