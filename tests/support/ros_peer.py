"""ROS nodes beside the robot agent, and what headsets send, for the tests."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from typing import Any

from geometry_msgs.msg import Twist
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import SetBool

from bridge.ros.nodes import InterfaceNodes
from bridge.ros.session import RosSession
from bridge.ros.topics import PublisherNode
from macs_zenoh.agent import Agent
from macs_zenoh.mesh import Sample
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.protocol.messages import (
    AddNode,
    Metadata,
    NodeType,
    RemoveNode,
    StreamData,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.reading import Message
from tests.support.waiting import get, until

ROBOT = 7
"""Id of the robot that the fixture ``robot`` gives."""


class Peer:
    """A ROS node beside the agent, in a context of its own, with rclpy's own typed publishers and subscriptions."""

    def __init__(self, domain_id: int, name: str = "peer") -> None:
        self.session = RosSession(name, domain_id=domain_id)

    async def publisher(self, kind: type[Any], topic: str, qos: Any = 10, *, matched: int = 0) -> Any:
        """A publisher, once it has ``matched`` subscriptions."""
        publisher = await self.session.run(lambda: self.session.node.create_publisher(kind, topic, qos))
        await until(lambda: publisher.get_subscription_count() >= matched)
        return publisher

    async def subscription(self, kind: type[Any], topic: str, qos: Any = 10) -> asyncio.Queue[Any]:
        """A subscription; its messages are put into the queue."""
        received: asyncio.Queue[Any] = asyncio.Queue()
        loop = asyncio.get_running_loop()

        def receive(message: Any) -> None:
            loop.call_soon_threadsafe(received.put_nowait, message)

        await self.session.run(lambda: self.session.node.create_subscription(kind, topic, receive, qos))
        return received

    async def service(self, kind: type[Any], name: str, answer: Any, robot: RosSession, depth: int = 10) -> Any:
        """A service, once the robot knows of it: for a call that comes sooner there is none. So many requests wait for
        it; ROS loses more without a word, as of a service that is kept from the processor."""
        kept = QoSProfile(depth=depth)
        service = await self.session.run(
            lambda: self.session.node.create_service(kind, name, answer, qos_profile=kept)
        )
        await known(robot, name)
        return service

    async def sees(self, topic: str, *, publishers: int = 0, subscriptions: int = 0) -> None:
        """Wait until this node knows of exactly so many publishers and subscriptions of a topic, its own included."""
        node = self.session.node
        await until(
            lambda: node.count_publishers(topic) == publishers and node.count_subscribers(topic) == subscriptions
        )


async def reaches(nodes: InterfaceNodes, topic: str) -> None:
    """Wait until what the robot publishes on a topic arrives: ROS loses what a publisher says before it has found its
    subscriptions, whatever these know."""
    node = nodes.on_topic(NodeType.PUBLISHER, topic)
    assert isinstance(node, PublisherNode)
    made = node._publisher._made  # type: ignore[union-attr]
    await until(made.get_subscription_count)


async def known(robot: RosSession, *services: str) -> None:
    """Wait until the robot knows of a server of each of these services."""
    await until(lambda: all(robot.node.count_services(service) for service in services))


async def known_action(robot: RosSession, action: str) -> None:
    """The same of an action."""
    await known(robot, *(f"{action}/_action/{part}" for part in ("send_goal", "get_result", "cancel_goal")))


TO_NOBODY = encode_management(StreamData({}))


class Streams:
    """Everything that a robot streams, as an agent on the mesh gets it, but for the counts that are for gateways."""

    def __init__(self, agent: Agent, robot: int = ROBOT) -> None:
        self.frames: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue()
        self._subscription = agent.mesh.subscribe(STREAM.every(type=1, id=robot), self._take)

    def _take(self, batch: Iterator[Sample]) -> None:
        for key, payload in batch:
            if TO_NOBODY not in payload:
                self.frames.put_nowait((key, payload))

    async def after(self, publish: Callable[[], None]) -> tuple[str, bytes]:
        """Key and frame of what comes when ``publish`` is done, again and again until something comes.

        The first can be earlier than the robot's router knows of our subscription.
        """

        def again() -> bool:
            publish()
            return not self.frames.empty()

        await until(again)
        return await get(self.frames)


def pause(node: Any, seconds: float) -> Any:
    """A future of rclpy that is done after a time."""
    future = Future()

    def wake() -> None:
        timer.cancel()
        node.destroy_timer(timer)
        future.set_result(None)

    timer = node.create_timer(seconds, wake)
    return future


def set_bool(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    """A service that answers with what it was asked."""
    response.success, response.message = request.data, f"set to {request.data}"
    return response


async def say_hello(peer: Peer, publisher: Any) -> None:
    """Publish a String ten times a second, until cancelled."""
    while True:
        await peer.session.run(lambda: publisher.publish(String(data="hello from ROS")))
        await asyncio.sleep(0.1)


def adding(
    topic: str,
    data_type: str = "std_msgs/String",
    *,
    node_type: int = NodeType.SUBSCRIBER,
    registrant: int = 5,
    name: str | None = None,
    **options: Any,
) -> AddNode:
    """A registration by a headset."""
    return AddNode(2, registrant, int(node_type), name or node_name(topic), topic, data_type, **options)


def removing(topic: str, *, node_type: int = NodeType.SUBSCRIBER, registrant: int = 5) -> RemoveNode:
    """A headset's request to be taken off a node."""
    return RemoveNode(2, registrant, int(node_type), node_name(topic))


def command(topic: str, data: Any, data_type: str = "std_msgs/String") -> Message:
    """A headset's message for a publisher node; ``data`` is CDR or a ROS message."""
    cdr = data if isinstance(data, bytes) else bytes(serialize_message(data))
    metadata = Metadata(2, 5, node_type=NodeType.PUBLISHER, node_name=node_name(topic), data_exchange_type=data_type)
    return Message("unity", 5, metadata, cdr)


def drive(x: float, sender: int = 5, topic: str = "/cmd_vel") -> Message:
    """A headset's command to drive at this speed."""
    twist = Twist()
    twist.linear.x = float(x)
    return command(topic, twist, "geometry_msgs/Twist")._replace(sender_id=sender)
