"""The ends of what `rmw` measures: a node of a robot that runs rmw_zenoh, and a plain Zenoh subscriber.

``python -m benchmarks.rmw_ends publish|take PORT`` joins the router on that port of 127.0.0.1, without ROS.
"""

from __future__ import annotations

import asyncio
import json
import sys
import threading
import time
from typing import Any

import zenoh

from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.ros_network import RosNetwork
from macs_zenoh.protocol.rmw_zenoh.qos import SERVICES
from macs_zenoh.type_hashes import Hashes
from macs_zenoh.typed import Types

from .robot_ends import TYPE, Arrivals, pace, stamped
from .worker import serve

TOPIC = "/robot"
FULL = TYPE.replace("/", "/msg/")


class Node:
    """Publishes `TOPIC`."""

    def __init__(self, port: int) -> None:
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        self._network = self.run(RosNetwork.open(MeshSettings(connect=[f"tcp/127.0.0.1:{port}"])))
        self._node = self._network.node(0, "bench")
        self._publisher = self._node.publisher(TOPIC, FULL, Hashes(Types()).of(FULL), SERVICES)

    def run(self, work: Any) -> Any:
        """On the loop."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(60)

    def publish(self, size: int, hz: float, count: int) -> dict[str, Any]:
        """Publish at a rate."""
        began = time.monotonic()
        pace(count, hz, lambda message: self._publisher.publish(bytes(message)), stamped(size))
        return {"took_s": time.monotonic() - began}

    def close(self) -> None:
        """Leave."""
        self.run(self._network.close())


class Plain:
    """A subscriber of Zenoh's own, without anything of ours."""

    def __init__(self, port: int) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self._session = zenoh.open(config)
        self._arrivals = Arrivals()
        self._subscriber = self._session.declare_subscriber(f"0{TOPIC}/**", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        self._arrivals.take(sample.payload.to_bytes())

    def collect(self, count: int, quiet_s: float) -> dict[str, Any]:
        """Wait for so many, or until nothing has come for a while."""
        arrivals = self._arrivals
        arrivals.last = time.monotonic()
        while len(arrivals.latencies) < count and time.monotonic() - arrivals.last < quiet_s:
            time.sleep(0.05)
        return arrivals.report()

    def close(self) -> None:
        """Leave."""
        self._session.close()  # type: ignore[no-untyped-call]


def main() -> None:
    """Run the worker."""
    kind, port = sys.argv[1], int(sys.argv[2])
    end = Node(port) if kind == "publish" else Plain(port)
    serve({}, {"publish": end.publish} if isinstance(end, Node) else {"collect": end.collect})
    end.close()


if __name__ == "__main__":
    main()
