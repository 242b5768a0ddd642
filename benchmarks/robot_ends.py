"""Workers at the ends of a robot: ROS nodes, and headsets on blocking sockets, that stamp messages and time them.

``python -m benchmarks.robot_ends ros`` is a ROS node (domain: ROS_DOMAIN_ID); ``... headset PORT COUNT`` is COUNT
headsets. Each message of std_msgs/UInt8MultiArray carries its number and when it was sent (CLOCK_MONOTONIC, the same
in every process), so loss and latency are known where it arrives. ROS data is raw bytes at every end.
"""

from __future__ import annotations

import select
import socket
import struct
import sys
import threading
import time
from statistics import quantiles
from typing import Any

from bridge.headset import frames
from bridge.headset.frames import NodeSpec
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import NodeType
from macs_zenoh.protocol.wire import split_message

from .headset import RECEIVE_BYTES, Headset
from .worker import serve

TYPE = "std_msgs/UInt8MultiArray"
PREFIX = b"\x00\x01\x00\x00" + bytes(8)
"""CDR header, no dimensions, offset 0; then the length of the data and the data."""
STAMP = struct.Struct("<dI")
AT = len(PREFIX) + 4

LEAD_S = 0.3
"""So long a headset has commanded before what it sends counts. Whoever drives on after a pause of a second may have
been cut off: of what comes together then a gateway passes on the newest, and any stall here brings some together."""
UNCOUNTED = 1 << 31
"""The number of what does not count."""


def stamped(size: int) -> bytearray:
    """CDR of a message with ``size`` bytes of data."""
    return bytearray(PREFIX + struct.pack("<I", size) + bytes(size))


def pace(count: int, hz: float, send: Any, message: bytearray, at: int = AT, lead: int = 0) -> float:
    """Stamp a message ``at`` its data and send it, at a rate; a late one does not delay those that follow. ``lead`` go
    before them, uncounted. Returns when the first of the others was due."""
    began = time.monotonic() + lead / hz
    for number in range(-lead, count):
        wait_s = began + number / hz - time.monotonic()
        if wait_s > 0:
            time.sleep(wait_s)
        STAMP.pack_into(message, at, time.monotonic(), number if number >= 0 else UNCOUNTED)
        send(message)
    return began


class Arrivals:
    """What arrived: latencies and numbers."""

    def __init__(self) -> None:
        self.latencies: list[float] = []
        self.last = 0.0

    def take(self, cdr: Any) -> None:
        """Note one message that came now."""
        self.note(cdr, time.monotonic())

    def note(self, cdr: Any, now: float) -> None:
        """Note one message that came then."""
        sent, number = STAMP.unpack_from(cdr, AT)
        self.last = now
        if number != UNCOUNTED:
            self.latencies.append(now - sent)

    def report(self) -> dict[str, Any]:
        """How many, and their latencies in ms; then begin anew."""
        latencies, self.latencies = self.latencies, []
        if len(latencies) < 2:
            return {"got": len(latencies), "p50_ms": float("inf"), "p99_ms": float("inf")}
        cuts = quantiles(latencies, n=100)
        return {"got": len(latencies), "p50_ms": cuts[49] * 1000, "p99_ms": cuts[98] * 1000}


class RosEnd:
    """A ROS node that publishes in this thread and receives in another."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from std_msgs.msg import UInt8MultiArray

        rclpy.init()
        self._kind = UInt8MultiArray
        self._node = rclpy.create_node("bench")
        self._arrivals = Arrivals()
        self._publishers: dict[str, Any] = {}
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        threading.Thread(target=executor.spin, daemon=True).start()

    def subscribe(self, topic: str, depth: int) -> dict[str, Any]:
        """Receive a topic, raw."""
        self._node.create_subscription(self._kind, topic, self._arrivals.take, depth, raw=True)
        return {}

    def advertise(self, topic: str, depth: int, matched: int) -> dict[str, Any]:
        """Publish a topic, once it has so many subscriptions."""
        self._publishers[topic] = publisher = self._node.create_publisher(self._kind, topic, depth)
        deadline = time.monotonic() + 10
        while publisher.get_subscription_count() < matched and time.monotonic() < deadline:
            time.sleep(0.02)
        time.sleep(0.3)
        return {"matched": publisher.get_subscription_count()}

    def publish(self, topic: str, size: int, hz: float, count: int) -> dict[str, Any]:
        """Publish at a rate."""
        publisher = self._publishers[topic]
        began = time.monotonic()
        pace(count, hz, lambda message: publisher.publish(bytes(message)), stamped(size))
        return {"took_s": time.monotonic() - began}

    def collect(self, count: int, quiet_s: float) -> dict[str, Any]:
        """Wait for so many, or until nothing has come for a while."""
        arrivals = self._arrivals
        arrivals.last = time.monotonic()
        while len(arrivals.latencies) < count and time.monotonic() - arrivals.last < quiet_s:
            time.sleep(0.01)
        return arrivals.report()


class HeadsetEnd:
    """Headsets on blocking sockets."""

    def __init__(self, port: int, count: int) -> None:
        self._headsets = [Headset.join(port, 0) for _ in range(count)]
        self._decoders = [MessageDecoder() for _ in self._headsets]
        self._buffer = memoryview(bytearray(RECEIVE_BYTES))

    def beat(self) -> None:
        """Heartbeats, where due."""
        for headset in self._headsets:
            headset.beat()

    def register(self, topic: str, kind: int, buffer: int, robot: int = 1) -> dict[str, Any]:
        """Every headset registers on a robot."""
        spec = NodeSpec(NodeType(kind), topic, TYPE, buffer)
        for headset in self._headsets:
            headset.socket.sendall(frames.registration(headset.id, spec, [robot], []))
        return {}

    def publish(self, topic: str, size: int, hz: float, count: int) -> dict[str, Any]:
        """The first headset publishes to robot 1 at a rate. Only the data of its frame changes."""
        headset = self._headsets[0]
        spec = NodeSpec(NodeType.PUBLISHER, topic, TYPE)
        cdr = stamped(size)
        frame = bytearray(frames.node_data(headset.id, spec, cdr, [1]))
        at = len(frame) - len(cdr) + AT
        began = pace(count, hz, headset.socket.sendall, frame, at, lead=round(LEAD_S * hz))
        return {"took_s": time.monotonic() - began}

    def collect(self, count: int, quiet_s: float) -> dict[str, Any]:
        """Wait until every headset has so many, or until nothing has come for a while; the worst of them.

        A message has come when its last bytes are received: what Python takes to find it among them is not measured.
        """
        arrivals = [Arrivals() for _ in self._headsets]
        sockets = {headset.socket: number for number, headset in enumerate(self._headsets)}
        last = time.monotonic()
        while time.monotonic() - last < quiet_s and any(len(a.latencies) < count for a in arrivals):
            received = [(ready, *self._receive(ready)) for ready in select.select(list(sockets), [], [], 0.1)[0]]
            for ready, chunk, now in received:
                number = sockets[ready]
                for message in self._decoders[number].feed(chunk):
                    _, data = split_message(message)
                    if len(data) > AT + STAMP.size and bytes(data[:2]) == b"\x00\x01":
                        arrivals[number].note(data, now)
                        last = now
            self.beat()
        return self._worst(arrivals)

    def look(self, quiet_s: float) -> dict[str, Any]:
        """Take what comes, and look at none of it, until nothing has come for a while."""
        last, taken = time.monotonic(), 0
        while time.monotonic() - last < quiet_s:
            for ready in select.select([headset.socket for headset in self._headsets], [], [], 0.1)[0]:
                taken += ready.recv_into(self._buffer)
                last = time.monotonic()
            self.beat()
        return {"bytes": taken}

    def _receive(self, ready: socket.socket) -> tuple[bytes, float]:
        """What a socket has, and when it was received."""
        size = ready.recv_into(self._buffer)
        now = time.monotonic()
        return bytes(self._buffer[:size]), now

    @staticmethod
    def _worst(arrivals: list[Arrivals]) -> dict[str, Any]:
        reports = [one.report() for one in arrivals]
        return {
            "got": min(report["got"] for report in reports),
            "p50_ms": max(report["p50_ms"] for report in reports),
            "p99_ms": max(report["p99_ms"] for report in reports),
        }


def main() -> None:
    """Run the worker."""
    end: Any
    if sys.argv[1] == "ros":
        end = RosEnd()
        works, idle = {name: getattr(end, name) for name in ("subscribe", "advertise", "publish", "collect")}, None
    else:
        end = HeadsetEnd(int(sys.argv[2]), int(sys.argv[3]))
        works, idle = {name: getattr(end, name) for name in ("register", "publish", "collect", "look")}, end.beat
    serve({}, works, idle or (lambda: None))


if __name__ == "__main__":
    main()
