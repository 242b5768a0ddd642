"""The page of a gateway of a large mesh: what it costs the browser, with robots and headsets that are only seen."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from functools import partial
from typing import Any

import pytest

from macs_zenoh.mesh import Mesh
from macs_zenoh.presence import Presence
from macs_zenoh.protocol.keyexpr import CALL
from macs_zenoh.protocol.messages import ROS, UNITY
from tests.support.browser import browser, needs_browser, opened
from tests.support.given import StartGateway
from tests.support.local import patient
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
        return json.dumps({"status": STATUS, "offers": OFFERS}.get(str(fields.verb), {})).encode()

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
