"""Robots with rclpy and robots that run rmw_zenoh on one mesh: a headset does not know which is which."""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import AsyncExitStack

import pytest
from std_msgs.msg import String

from bridge.headset.client import Headset
from macs_zenoh import ros
from macs_zenoh.protocol.rmw_zenoh.cdr import read_text
from tests.support.programs import Program
from tests.support.ros_peer import Peer
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)


async def test_one_registration_for_robots_of_both_kinds(domain: int) -> None:
    """A headset that registers for a group hears robots of both kinds; a robot that moves from one kind to the other,
    with its id, keeps the headset."""
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        router = await enter(Router())
        gateway = await enter(Program("gateway", "--port", "0", "-e", router.endpoint))
        arguments = ("--group", "3", "-e", router.endpoint)
        await enter(Program("agent", "--id", "1", *arguments, env={"ROS_DOMAIN_ID": str(domain)}))
        other = await enter(AsyncExitStack())
        await other.enter_async_context(Program("rmw-zenoh", "--id", "7", *arguments))
        talker = await enter(ros.node("talker", connect=[router.endpoint]))
        zenoh_says = talker.publisher("/chatter", "std_msgs/String")
        peers = [Peer(each) for each in (domain, domain + 100)]
        for peer in peers:
            stack.callback(peer.session.close)
        rclpy_says = [await peer.publisher(String, "/chatter") for peer in peers]
        headset = await enter(await Headset.connect("127.0.0.1", gateway.port, group=5))
        heard: Counter[tuple[int, str]] = Counter()
        messages = await headset.subscribe("/chatter", "std_msgs/String", groups=[3])

        async def listen() -> None:
            async for message in messages:
                heard[message.sender_id, read_text(bytes(message.data)).decode()] += 1  # ROS pads

        listening = asyncio.create_task(listen())
        stack.callback(listening.cancel)

        def hears(*expected: tuple[int, str]) -> bool:
            zenoh_says.publish({"data": "by zenoh"})
            for number, publisher in enumerate(rclpy_says):
                publisher.publish(String(data=f"by rclpy {number}"))
            return all(heard[each] for each in expected)

        await until(lambda: hears((1, "by rclpy 0"), (7, "by zenoh")), PATIENCE_S, every_s=0.05)
        await other.aclose()
        heard.clear()
        await enter(Program("agent", "--id", "7", *arguments, env={"ROS_DOMAIN_ID": str(domain + 100)}))
        await until(lambda: hears((1, "by rclpy 0"), (7, "by rclpy 1")), PATIENCE_S, every_s=0.05)
