"""Robots with rclpy and robots that run rmw_zenoh on one mesh: a headset does not know which is which."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import AsyncExitStack

import pytest
from std_msgs.msg import String

from bridge.headset.client import Headset
from bridge.headset.nodes import Incoming
from macs_zenoh import ros
from macs_zenoh.protocol.rmw_zenoh.cdr import read_text, written_text
from tests.support.programs import Program
from tests.support.ros_peer import Peer
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)

TOPICS = ("/chatter", "/pose")


async def test_one_registration_for_robots_of_both_kinds(domain: int) -> None:
    """A headset that registers for a group, for ids, and to publish, has robots of both kinds; a robot that moves from
    one kind to the other, with its id, keeps the headset, which does nothing for it."""
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        router = await enter(Router())
        gateway = await enter(Program("gateway", "--port", "0", "-e", router.endpoint))
        arguments = ("--group", "3", "-e", router.endpoint)
        await enter(Program("agent", "--id", "1", *arguments, env={"ROS_DOMAIN_ID": str(domain)}))
        other = await enter(AsyncExitStack())
        await other.enter_async_context(Program("rmw-zenoh", "--id", "7", *arguments))
        talker = await enter(ros.node("talker", connect=[router.endpoint]))
        zenoh_says = [talker.publisher(topic, "std_msgs/String") for topic in TOPICS]
        zenoh_orders = talker.subscribe("/orders", "std_msgs/String")
        peers = [Peer(each) for each in (domain, domain + 100)]
        for peer in peers:
            stack.callback(peer.session.close)
        rclpy_says = [[await peer.publisher(String, topic) for topic in TOPICS] for peer in peers]
        rclpy_orders = [await peer.subscription(String, "/orders") for peer in peers]
        headset = await enter(await Headset.connect("127.0.0.1", gateway.port, group=5))
        heard: Counter[tuple[str, int, str]] = Counter()

        def hear(topic: str) -> Callable[[Incoming], None]:
            def take(message: Incoming) -> None:
                assert message.sender_id is not None
                heard[topic, message.sender_id, read_text(bytes(message.data)).decode()] += 1  # ROS pads

            return take

        await headset.subscribe("/chatter", "std_msgs/String", groups=[3], callback=hear("/chatter"))
        await headset.subscribe("/pose", "std_msgs/String", agents=[1, 7], callback=hear("/pose"))
        orders = await headset.advertise("/orders", "std_msgs/String", groups=[3])

        async def hears(*expected: tuple[int, str]) -> bool:
            for publisher in zenoh_says:
                publisher.publish({"data": "by zenoh"})
            for number, publishers in enumerate(rclpy_says):
                for each in publishers:
                    each.publish(String(data=f"by rclpy {number}"))
            await orders.publish(written_text(b"go"))
            return all(heard[(topic, *each)] for topic in TOPICS for each in expected)

        await until(lambda: hears((1, "by rclpy 0"), (7, "by zenoh")), PATIENCE_S, every_s=0.05)
        await until(lambda: zenoh_orders._waiting and not rclpy_orders[0].empty(), PATIENCE_S)
        assert rclpy_orders[1].empty()  # nobody has robot 7 there yet
        await other.aclose()
        heard.clear()
        await enter(Program("agent", "--id", "7", *arguments, env={"ROS_DOMAIN_ID": str(domain + 100)}))
        await until(lambda: hears((1, "by rclpy 0"), (7, "by rclpy 1")), PATIENCE_S, every_s=0.05)

        async def obeys() -> bool:
            await orders.publish(written_text(b"go"))
            return not rclpy_orders[1].empty()

        await until(obeys, PATIENCE_S, every_s=0.05)
