"""A robot made of zenoh-ros2-sdk, which nobody here wrote: a worker (``-m tests.support.sdk_robot PORT DOMAIN``).

Types are given as text: the SDK would get them from the internet.
"""

from __future__ import annotations

import asyncio
import os
import sys
from typing import Any

from tests.support.workers import serve

STRING = {"msg_type": "std_msgs/msg/String", "msg_definition": "string data\n"}
SET_BOOL = {
    "srv_type": "std_srvs/srv/SetBool",
    "request_definition": "bool data\n",
    "response_definition": "bool success\nstring message\n",
    "type_hash": "RIHS01_abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
}


class SdkRobot:
    """Its publishers, subscriptions, services and clients."""

    def __init__(self, port: int, domain: int) -> None:
        self._at = {"router_port": port, "domain_id": domain}
        self._publishers: dict[str, Any] = {}
        self._kept: list[Any] = []
        self._clients: dict[str, Any] = {}
        self._heard: dict[str, list[str]] = {}
        self._asked: list[bool] = []

    async def publish(self, topic: str, text: str, qos: str | None = None, namespace: str = "/") -> None:
        """Publish a text; the publisher stays."""
        await asyncio.to_thread(self._publish, topic, text, qos, namespace)

    def _publish(self, topic: str, text: str, qos: str | None, namespace: str) -> None:
        from zenoh_ros2_sdk import ROS2Publisher

        if topic not in self._publishers:
            self._publishers[topic] = ROS2Publisher(
                topic, **STRING, **self._at, qos=qos, namespace=namespace, node_name="sdk_talker"
            )
        self._publishers[topic].publish(data=text)

    async def subscribe(self, topic: str, namespace: str = "/") -> None:
        """Subscribe to texts."""
        from zenoh_ros2_sdk import ROS2Subscriber

        heard = self._heard.setdefault(topic, [])
        options = {**STRING, **self._at, "namespace": namespace, "node_name": "sdk_listener"}
        self._kept.append(
            await asyncio.to_thread(lambda: ROS2Subscriber(topic, callback=lambda m: heard.append(m.data), **options))
        )

    async def heard(self, topic: str) -> list[str]:
        """The texts that came."""
        return self._heard.get(topic, [])

    async def serve_set_bool(self, name: str) -> None:
        """Have a SetBool service: it says what it was asked."""
        from zenoh_ros2_sdk import ROS2ServiceServer

        def answer(request: Any) -> Any:
            self._asked.append(bool(request.data))
            return server.response_msg_class(success=request.data, message=f"sdk says {request.data}")

        server = await asyncio.to_thread(
            lambda: ROS2ServiceServer(name, callback=answer, **SET_BOOL, **self._at, node_name="sdk_server")
        )
        self._kept.append(server)

    async def call_set_bool(self, name: str, data: bool) -> list[Any] | None:
        """Call a SetBool service: what it answered."""
        from zenoh_ros2_sdk import ROS2ServiceClient

        if name not in self._clients:
            self._clients[name] = await asyncio.to_thread(
                lambda: ROS2ServiceClient(name, **SET_BOOL, **self._at, timeout=10.0, node_name="sdk_client")
            )
        response = await asyncio.to_thread(lambda: self._clients[name].call(data=data))
        return None if response is None else [bool(response.success), response.message]

    async def topics(self) -> dict[str, list[str]]:
        """What the SDK sees of the graph, as its `topic list` does."""
        from zenoh_ros2_sdk import get_topic_names_and_types

        found = await asyncio.to_thread(lambda: get_topic_names_and_types(**self._at))
        return {name: list(types) for name, types in dict(found).items()}


async def _make() -> SdkRobot:
    return SdkRobot(int(sys.argv[1]), int(sys.argv[2]))


if __name__ == "__main__":
    asyncio.run(serve(_make()))
    os._exit(0)  # the SDK's session has no end of its own, and a process that exits with an open one hangs
