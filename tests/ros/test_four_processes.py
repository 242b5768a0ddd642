"""The main job on real parts: router, two gateways and a robot agent as four processes, a headset on each gateway."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass

import pytest
from rclpy.serialization import serialize_message
from std_msgs.msg import String

import macs_zenoh
from bridge.headset.client import Headset
from macs_zenoh.protocol.messages import Functionality, decode_data
from tests.support.programs import Program, free_port, macs
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, first_of, get


@dataclass
class Site:
    """Everything that runs."""

    endpoint: str
    gateways: list[Program]
    headsets: list[Headset]


@pytest.fixture
async def site(domain: int) -> AsyncIterator[Site]:
    """Four processes and two headsets, both in group 4."""
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        await stack.enter_async_context(Program("router", "-l", endpoint))
        first = await stack.enter_async_context(Program("gateway", "--port", "0", "-e", endpoint))
        second = await stack.enter_async_context(Program("gateway", "--port", "0", "-e", endpoint))
        robot = Program("agent", "--id", "1", "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)})
        await stack.enter_async_context(robot)
        headsets = [
            await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port, group=4))
            for gateway in (first, second)
        ]
        for headset in headsets:
            await sees(headset, robots=[1], headsets=[h.id for h in headsets])
        yield Site(endpoint, [first, second], headsets)


async def sees(headset: Headset, *, robots: list[int], headsets: list[int]) -> None:
    """Wait until the router tells a headset of exactly these agents."""
    while True:
        online = await headset.online()
        if online.ros_agent_ids == robots and online.unity_agent_ids == sorted(headsets):
            return
        await asyncio.sleep(0.02)


async def test_ids_start_at_one_and_everybody_is_listed(site: Site) -> None:
    """Headsets get ids from 1 up, unique over both gateways, and `macs ls --json` shows robot and both."""
    first, second = site.headsets
    assert first.id == 2, "1 is the robot's, as when one counter served both types"
    assert second.id >= 256, "the second gateway has a block of its own"
    listed = await macs("ls", "--json", "-e", site.endpoint)
    assert {(a["type"], a["id"], a["group"]) for a in listed} == {
        ("ros", 1, 0),
        ("unity", first.id, 4),
        ("unity", second.id, 4),
    }


async def test_both_get_the_same_topic(site: Site, peer: Peer) -> None:
    """Headsets on two gateways receive every message of one topic of the robot, in order and unchanged."""
    subscriptions = [
        await h.subscribe("/chatter", "std_msgs/String", agents=[1], buffer_size=100) for h in site.headsets
    ]
    publisher = await peer.publisher(String, "/chatter", 100, matched=1)
    expected = [f"message {number}" for number in range(20)]
    # registration takes its way while the topic is there: send until both hear it, then count
    for subscription in subscriptions:
        await first_of(subscription.__anext__(), lambda: publisher.publish(String(data="early")))
    for text in expected:
        publisher.publish(String(data=text))
    for subscription in subscriptions:
        heard: list[str] = []
        while len(heard) < len(expected):
            message = await asyncio.wait_for(subscription.__anext__(), PATIENCE_S)
            text = message.data[8:].rstrip(b"\0").decode()
            if text != "early":
                heard.append(text)
        assert heard == expected


async def test_both_publish_to_one_topic(site: Site, peer: Peer) -> None:
    """What headsets on two gateways publish arrives on the robot's topic, each message once."""
    received = await peer.subscription(String, "/orders")
    async with macs_zenoh.join("unity", id=9, connect=[site.endpoint]) as observer:
        offers = Functionality()
        while "/orders" not in offers.subscribers:  # what ROS has not discovered yet, nobody can publish to
            offers = decode_data(Functionality, await observer.call("ros", 1, "offers"))
    for headset in site.headsets:
        await headset.publish(
            "/orders", "std_msgs/String", serialize_message(String(data=f"from {headset.id}")), agents=[1]
        )
    assert {(await get(received)).data for _ in site.headsets} == {f"from {h.id}" for h in site.headsets}
    assert received.empty()


async def test_headsets_reach_each_other_once(site: Site) -> None:
    """A headset reaches one on another gateway by id, by group, by both and by broadcast: once, and not itself."""
    first, second = site.headsets
    ways: dict[str, tuple[int, list[int], list[int]]] = {
        "id": (2, [second.id], []),
        "group": (2, [], [4]),
        "both": (2, [second.id], [4]),
        "broadcast": (0, [], []),
    }
    for how, (to, ids, groups) in ways.items():
        said = [f"hello by {how}".encode(), b"end"]
        for text in said:  # on one way the order is kept: what follows shows that nothing came twice
            await first.send(text, to=to, ids=ids, groups=groups, manager="Greeting")
        messages = [await second.receive(PATIENCE_S) for _ in said]
        assert [bytes(message.data) for message in messages] == said
        assert {(message.sender_type, message.sender_id) for message in messages} == {(2, first.id)}
        await second.send(b"nothing before this", to=2, ids=[first.id], manager="Greeting")
        assert bytes((await first.receive(PATIENCE_S)).data) == b"nothing before this"


async def test_a_killed_gateway_takes_only_its_own_headsets(site: Site, peer: Peer, domain: int) -> None:
    """After kill -9 of a gateway its headset is gone, and the other headset's stream goes on."""
    first, second = site.headsets
    subscription = await second.subscribe("/chatter", "std_msgs/String", agents=[1])
    publisher = await peer.publisher(String, "/chatter", 100, matched=1)
    await first_of(subscription.__anext__(), lambda: publisher.publish(String(data="before")))

    site.gateways[0].send_signal(signal.SIGKILL)
    await sees(second, robots=[1], headsets=[second.id])
    await first_of(subscription.__anext__(), lambda: publisher.publish(String(data="after")))
    assert await asyncio.wait_for(first.wait_ended(), PATIENCE_S)
