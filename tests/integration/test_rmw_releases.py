"""Robots of other ROS releases: Humble, which has no hashes, and Lyrical, which puts buffers beside a topic."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from bridge.rmw_zenoh.session import ZenohSession
from bridge.rmw_zenoh.types import KnownTypes
from bridge.ros.types import InterfaceName
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.ros_network import RosNetwork
from macs_zenoh.protocol.rmw_zenoh.attachment import encode_attachment
from macs_zenoh.protocol.rmw_zenoh.keyexpr import CPU_BACKENDS, HASH_NOT_SUPPORTED, Kind, cpu_key
from macs_zenoh.protocol.rmw_zenoh.qos import Qos
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")

STRING = InterfaceName("std_msgs", "msg", "String")
TEXT = b"\0\1\0\0\3\0\0\0hi\0"
QOS = Qos(depth=10)


@asynccontextmanager
async def network(router: str) -> AsyncIterator[RosNetwork]:
    async with await RosNetwork.open(MeshSettings(connect=[router])) as made:
        yield made


@asynccontextmanager
async def session(router: str) -> AsyncIterator[ZenohSession]:
    async with network(router) as ours:
        types = await asyncio.to_thread(KnownTypes)
        made = ZenohSession(ours, types)
        try:
            yield made
        finally:
            await asyncio.to_thread(made.close)


async def test_a_robot_without_hashes(router: str) -> None:
    """What was subscribed and published before such a robot came is heard all the same; what is made after it has no
    hash either."""
    heard: list[bytes] = []
    there: list[bytes] = []

    def take(cdr: bytes, info: Any) -> None:
        heard.append(cdr)

    async with session(router) as ours, network(router) as humble:
        string = await ours.run(lambda: ours.message(STRING, "/chatter"))
        early = await ours.run(lambda: ours.subscribe(string, "/chatter", take, QOS))
        driving = await ours.run(lambda: ours.advertise(string, "/orders", QOS))
        assert early.entity.endpoint.hash.startswith("RIHS01_")
        node = humble.node(0, "talker")
        publisher = node.publisher("/chatter", str(STRING), HASH_NOT_SUPPORTED, QOS)
        node.subscription("/orders", str(STRING), HASH_NOT_SUPPORTED, QOS, lambda cdr, attached: there.append(cdr))

        def both() -> bool:
            publisher.publish(TEXT)
            driving.publish(TEXT)
            return bool(heard and there)

        await until(both, PATIENCE_S, every_s=0.05)
        assert early.entity.endpoint.hash == HASH_NOT_SUPPORTED
        assert ours.hash_of("/anything", str(STRING)) == HASH_NOT_SUPPORTED
        assert dict(ours.topics())["/chatter"] == [str(STRING)]


async def test_a_robot_that_puts_buffers_beside_a_topic(router: str) -> None:
    """Where nodes say in their tokens that they take such, our subscription does as well, and gets them."""
    heard: list[bytes] = []
    async with session(router) as ours, network(router) as lyrical:
        node = lyrical.node(0, "viewer")
        node.subscription("/camera", str(STRING), "RIHS01_ab", QOS, lambda cdr, attached: None, buffers=True)
        await until(lambda: ours.graph.on("/camera", Kind.SUBSCRIPTION), PATIENCE_S)
        string = await ours.run(lambda: ours.message(STRING, "/camera"))
        made = await ours.run(lambda: ours.subscribe(string, "/camera", lambda cdr, info: heard.append(cdr), QOS))
        assert made.entity.endpoint.more == (CPU_BACKENDS,)
        beside = lyrical.session.declare_publisher(cpu_key(made.entity.endpoint.key))

        def comes() -> bool:
            beside.put(TEXT, attachment=encode_attachment(1, 1, bytes(16)))
            return bool(heard)

        await until(comes, PATIENCE_S, every_s=0.05)
        assert heard[0] == TEXT
        shown = lyrical.graph(0).on("/camera", Kind.SUBSCRIPTION, others=True)
        assert [one.takes_cpu_buffers for one in shown] == [True]
