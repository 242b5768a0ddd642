"""What a large mesh costs who looks at it, the page's browser and `macs top`, with robots and headsets that are only
seen."""

from __future__ import annotations

import asyncio
import json
import re
import time
from collections.abc import AsyncIterator
from functools import partial
from typing import Any

import pytest

from macs_zenoh.mesh import Mesh
from macs_zenoh.presence import Presence
from macs_zenoh.protocol.keyexpr import CALL
from macs_zenoh.protocol.messages import ROS, UNITY
from tests.support.browser import browser, needs_browser, opened
from tests.support.gateways import cpu_s, memory_bytes
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.terminals import terminal
from tests.support.waiting import until

ROBOTS, HEADSETS, TOPICS = 200, 1000, 500
MOST_CPU = 0.25
MOST_BYTES = 150e6
MEASURED_S = 8.0

STATUS: dict[str, Any] = {
    "ros_node": "/r",
    "stopped": False,
    "stop": {},
    "nodes": [
        {"role": "publisher", "name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "control": {"holder": None}}
    ],
    "drops": {},
}
CARRIED = {"registrants": ["unity/20001"], "carried": {"messages": 10, "bytes": 800, "age_s": 0.1}}
MORE = [
    {"role": "subscriber", "name": f"/{name}", "type": "std_msgs/msg/Float64", **CARRIED}
    for name in ("pose", "scan", "odom")
]
OFFERS = {
    "subscribers": {"/cmd_vel": "geometry_msgs/msg/Twist"},
    "publishers": {f"/sensor_{number}/value": "std_msgs/msg/Float64" for number in range(TOPICS)},
}


@pytest.fixture
async def crowd(router: str) -> AsyncIterator[None]:
    """Robots and headsets of one session, which answers for them all."""

    async def answer(key: str, payload: bytes) -> bytes:
        fields = CALL.parse(key)
        assert fields is not None
        status = {**STATUS, "nodes": [*STATUS["nodes"], *MORE[: 2 + fields.id % 2]]}  # 500 in all that carry something
        return json.dumps({"status": status, "offers": OFFERS}.get(str(fields.verb), {})).encode()

    async with await Mesh.open(patient(router)) as mesh:
        serving = mesh.serve(CALL.every(type=ROS), answer)
        pings = mesh.answer_pings()
        presence = Presence(mesh, lambda changes: None, lambda contested: None)
        await presence.start()
        tokens = [presence.declare(ROS, number, 0) for number in range(1, ROBOTS + 1)]
        tokens += [presence.declare(UNITY, 20_000 + number, 0) for number in range(HEADSETS)]
        yield
        for each in (*tokens, serving, pings):
            each.close()
        presence.close()


@needs_browser
async def test_a_large_mesh_is_still_usable(start_gateway: StartGateway, crowd: None) -> None:
    """With 200 robots, 1000 headsets and 500 topics each view takes a quarter of a core and 150 MB at most, and
    answers a click."""
    gateway = await start_gateway(web_port=0)
    await until(lambda: len(gateway.directory) >= ROBOTS + HEADSETS)
    async with browser() as chromium:
        page = await opened(chromium, f"http://127.0.0.1:{gateway.listeners.web_port}/#mesh")
        session = await page.page.context.new_cdp_session(page.page)
        await session.send("Performance.enable")

        async def measured() -> tuple[float, float]:
            """Processor time and bytes of the page."""
            found = {each["name"]: each["value"] for each in (await session.send("Performance.getMetrics"))["metrics"]}
            return found["TaskDuration"], found["JSHeapUsedSize"]

        await until(partial(page.value, f"document.querySelectorAll('svg.mesh g.robot').length === {ROBOTS}"))
        await until(partial(page.value, "document.querySelectorAll('#mesh-robots td').length === 5 * 200"))
        for view in ("mesh", "robot"):
            await page.value(f"location.hash = '{view}'")
            if view == "robot":
                await until(partial(page.value, f"document.querySelectorAll('tr[data-topic]').length === {TOPICS}"))
            await asyncio.sleep(2.0)
            before, _ = await measured()
            await asyncio.sleep(MEASURED_S)
            after, heap = await measured()
            share = (after - before) / MEASURED_S
            print(f"{view}: {100 * share:.1f} % of a core, {heap / 1e6:.1f} MB")
            assert share <= MOST_CPU
            assert heap <= MOST_BYTES
        await page.page.get_by_role("button", name="Robot 117", exact=True).click()
        await page.page.wait_for_selector('[data-robot="117"][aria-pressed="true"]')
        await page.page.fill("#topics input[type=search]", "sensor_41")
        await until(partial(page.value, "document.querySelectorAll('tr[data-topic]').length === 11"))
        page.judge()


async def test_top_of_a_large_mesh_takes_little(start_gateway: StartGateway, crowd: None, router: str) -> None:
    """With 200 robots, 1000 headsets and 500 topics `macs top` takes a quarter of a core and 150 MB at most in each
    view, and follows keys."""
    gateway = await start_gateway()
    await until(lambda: len(gateway.directory) >= ROBOTS + HEADSETS)
    async with terminal("top", "-e", router, columns=120) as shown:
        pid = shown.process.pid
        await until(lambda: re.findall(rb"(\d+) robots .*? (\d+) topics", shown.seen)[-1:] == [(b"200", b"500")])
        for view in b"123456":
            shown.type(bytes([view]))
            before, began = cpu_s(pid), time.monotonic()
            await asyncio.sleep(MEASURED_S / 2)
            share, size = (cpu_s(pid) - before) / (time.monotonic() - began), memory_bytes(pid)
            print(f"view {view - ord('0')}: {100 * share:.1f} % of a core, {size / 1e6:.1f} MB")
            assert share <= MOST_CPU
            assert size <= MOST_BYTES
        shown.type(b"q")
        assert await shown.ended() == 0
