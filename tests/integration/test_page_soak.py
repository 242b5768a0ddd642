"""The page for a long time, in a short one: what comes many times as often, and everything opened and closed again."""

from __future__ import annotations

import asyncio
import json
import math
import os
import random
import struct
import time
import zlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import pytest

import macs_zenoh
from macs_zenoh.mesh import Mesh
from macs_zenoh.presence import Presence
from macs_zenoh.protocol.messages import (
    UNITY,
    AddNode,
    Metadata,
    NodeType,
    RemoveNode,
    StreamData,
    decode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams
from macs_zenoh.typed import Types
from tests.support.browser import Watched, browser, needs_browser, opened
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.waiting import until

pytest.importorskip("rosbags")

SOAKED_S = float(os.environ.get("MACS_PAGE_SOAK_S", "120"))
WARM_S = 20.0
POSES, PICTURES, STATES = 1000, 100, 50
"""Messages a second: of a place, of a picture, and of a battery."""
PUBLISHERS = {
    "/pose": "geometry_msgs/msg/PoseStamped",
    "/battery": "sensor_msgs/msg/BatteryState",
    "/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
    "/map": "nav_msgs/msg/OccupancyGrid",
}
MORE_BYTES, MORE_NODES, MORE_LISTENERS = 5e6, 400, 40
"""So much more there may be after the soak than before it: forty bytes for each message would be as much."""


def picture(number: int) -> bytes:
    """A PNG of 32 by 24 pixels of one colour."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\x00" + bytes([number & 0xFF, 80, 120]) * 32) * 24
    header = struct.pack(">IIBBBBB", 32, 24, 8, 2, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


class Robot:
    """Publishes what it has to whoever registers, many times as often as robots do."""

    def __init__(self, agent: macs_zenoh.Agent) -> None:
        self.agent = agent
        self.sent = 0
        self._streams = Streams(agent)
        self._registrants: dict[str, set[int]] = {}
        self._types = Types()
        agent.serve("add_node", self._add)
        agent.serve("remove_node", self._remove)
        agent.serve("offers", self._offers)
        agent.serve("status", self._status)

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(AddNode, call.data)
        self._registrants.setdefault(node.tos_name, set()).add(node.registrant_agent_id)
        if node.tos_name == "/map":
            self._put("/map", self.map)
        return b""

    async def _remove(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(RemoveNode, call.data)
        for topic, registrants in self._registrants.items():
            if node_name(topic) == node.node_name:
                registrants.discard(node.registrant_agent_id)
        return b""

    async def _offers(self, call: macs_zenoh.Call) -> bytes:
        return json.dumps({"publishers": PUBLISHERS, "subscribers": {}, "services": {}}).encode()

    async def _status(self, call: macs_zenoh.Call) -> bytes:
        drops = {"lost_in_ros": self.sent}
        return json.dumps({"ros_node": "/r", "stopped": False, "stop": {}, "nodes": [], "drops": drops}).encode()

    @property
    def map(self) -> dict[str, Any]:
        info = {"resolution": 0.1, "width": 400, "height": 400, "origin": {"orientation": {"w": 1.0}}}
        return {"header": {"frame_id": "map"}, "info": info, "data": [0] * 160_000}

    def _put(self, topic: str, value: dict[str, Any]) -> None:
        registrants = sorted(self._registrants.get(topic, ()))
        if not registrants:
            return
        kind = PUBLISHERS[topic]
        node = node_name(topic)
        metadata = Metadata(
            1, self.agent.id, 0, StreamData.manager, NodeType.SUBSCRIBER, node, kind.replace("/msg", "")
        )
        message = encode_message(metadata.encode(), self._types.serialize(kind, value))
        management = encode_management(StreamData({"2": registrants}))
        self._streams.publish(node, encode_frame(1, management=management, message=message))
        self.sent += 1

    async def run(self) -> None:
        """Ten times a second a tenth of all of it."""
        due = {"/pose": 0.0, "/battery": 0.0, "/camera/image/compressed": 0.0}
        began = last = time.monotonic()
        while True:
            await asyncio.sleep(0.01)
            now = time.monotonic()
            for topic, rate in (("/pose", POSES), ("/battery", STATES), ("/camera/image/compressed", PICTURES)):
                due[topic] = min(due[topic] + rate * (now - last), rate / 10)
                while due[topic] >= 1:
                    due[topic] -= 1
                    self._put(topic, self._value(topic, now - began))
            last = now

    def _value(self, topic: str, at_s: float) -> dict[str, Any]:
        if topic == "/pose":
            place = {"x": 3 * math.cos(at_s), "y": 3 * math.sin(at_s), "z": 0.0}
            pose = {"position": place, "orientation": {"w": 1.0}}
            return {"header": {"stamp": "now", "frame_id": "map"}, "pose": pose}
        if topic == "/battery":
            return {"header": {"stamp": "now"}, "percentage": 0.5 + 0.4 * math.sin(at_s)}
        return {"header": {"stamp": "now"}, "format": "png", "data": picture(self.sent)}


@asynccontextmanager
async def comings(router: str) -> AsyncIterator[None]:
    """Headsets that come and leave, ten a second."""
    async with await Mesh.open(patient(router)) as mesh:
        presence = Presence(mesh, lambda changes: None, lambda contested: None)
        await presence.start()

        async def come_and_leave() -> None:
            while True:
                token = presence.declare(UNITY, 20_000 + random.randrange(10_000), 0)
                await asyncio.sleep(0.1)
                token.close()

        coming = asyncio.create_task(come_and_leave())
        yield
        coming.cancel()
        await asyncio.wait([coming])
        presence.close()


async def there(page: Watched, selector: str) -> None:
    """Wait for an element without a handle of it, which would keep it when it is gone."""
    await until(partial(page.value, f"document.querySelector({json.dumps(selector)}) !== null"))


class Kept:
    """What a page's process keeps: bytes of its heap after a collection, elements, listeners."""

    def __init__(self, page: Watched, session: Any) -> None:
        self._page = page
        self._session = session

    async def now(self) -> dict[str, float]:
        """The least of three looks, when all panels are there and those that were closed are forgotten: what is in use
        at the moment is no leak."""
        await there(self._page, ".plotted[data-points]")
        await until(partial(self._page.value, "document.querySelectorAll('tr[data-topic]').length === 4"))
        await asyncio.sleep(3.0)
        found: dict[str, float] = {}
        for _ in range(3):
            await self._session.send("HeapProfiler.collectGarbage")
            told = (await self._session.send("Performance.getMetrics"))["metrics"]
            for each in told:
                if each["name"] in ("JSHeapUsedSize", "Nodes", "JSEventListeners", "Documents"):
                    found[each["name"]] = min(found.get(each["name"], math.inf), each["value"])
            await asyncio.sleep(0.3)
        return found


async def used(page: Watched, seconds: float) -> None:
    """Everything that somebody does with it, again and again."""
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        for view in ("mesh", "latency", "robot"):
            await page.value(f"location.hash = '{view}'")
            await asyncio.sleep(1.0)
        await page.value("macsPage.robotView.choose(2)")
        await asyncio.sleep(0.3)
        await page.value("macsPage.robotView.choose(7)")
        await there(page, "#trail canvas[data-map='400x400'][data-x]")
        for name in ("Show more around it", "Show less around it", "Clear"):
            await page.page.get_by_role("button", name=name).click()


@needs_browser
@pytest.mark.soak
@pytest.mark.timeout(SOAKED_S + 200)
async def test_a_page_keeps_no_more_and_no_more(router: str, start_gateway: StartGateway) -> None:
    """Poses at fifty times their usual rate, pictures at ten, headsets that come and leave, panels that are made and
    closed: what the page keeps does not grow."""
    gateway = await start_gateway(web_port=0)
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as agent, comings(router), browser() as chromium:
        robot = Robot(agent)
        running = asyncio.create_task(robot.run())
        page = await opened(chromium, f"http://127.0.0.1:{gateway.listeners.web_port}/")
        await there(page, "#trail canvas[data-x]")
        session = await page.page.context.new_cdp_session(page.page)
        await session.send("Performance.enable")
        kept = Kept(page, session)
        # as many events as are kept, so that there cannot be more
        await page.value("for (let each = 0; each < 250; each++) macsPage.tell('test', 'event ' + each)")
        await used(page, WARM_S)
        before, sent = await kept.now(), robot.sent
        await used(page, SOAKED_S)
        after = await kept.now()
        running.cancel()
        messages = robot.sent - sent
        shown = {name: f"{before[name]:.0f} -> {after[name]:.0f}" for name in before}
        print(f"{messages} messages: {shown}")
        await until(lambda: running.done())
        print(page.problems)
        page.judge()
    assert messages > 100 * SOAKED_S
    assert after["JSHeapUsedSize"] <= before["JSHeapUsedSize"] + MORE_BYTES
    assert after["Nodes"] <= before["Nodes"] + MORE_NODES
    assert after["JSEventListeners"] <= before["JSEventListeners"] + MORE_LISTENERS
    assert after["Documents"] == before["Documents"]
