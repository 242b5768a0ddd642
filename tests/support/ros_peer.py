"""ROS nodes beside the robot agent, and what headsets send, for the tests."""

from __future__ import annotations

import asyncio
from typing import Any

from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import SetBool

from bridge.ros.session import RosSession
from macs_zenoh.protocol.messages import AddNode, Metadata, NodeType, RemoveNode, node_name
from macs_zenoh.protocol.reading import Message
from tests.support.waiting import until


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

    async def sees(self, topic: str, *, publishers: int = 0, subscriptions: int = 0) -> None:
        """Wait until this node knows of exactly so many publishers and subscriptions of a topic, its own included."""
        node = self.session.node
        await until(
            lambda: node.count_publishers(topic) == publishers and node.count_subscribers(topic) == subscriptions
        )


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
