"""A gateway's page on a mesh with generated access rules, where it may ping nobody: what it shows of a robot."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Any

import aiohttp
import pytest

import macs_zenoh
from bridge.headset.client import Headset
from bridge.ros.traced import telling
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError, Refused
from macs_zenoh.protocol import ping, trace
from macs_zenoh.protocol.trace import TraceAnswer, TraceRequest
from tests.integration.test_trace import Robot
from tests.support.local import patient
from tests.support.programs import Program, free_port
from tests.support.secured import Site
from tests.support.waiting import until

STATUS = {"ros_node": "/r", "stopped": False, "nodes": [], "drops": {}}


async def _status(_: macs_zenoh.Call) -> bytes:
    return json.dumps(STATUS).encode()


@dataclass
class Look:
    """Robot 7, which talks, and what a gateway's page tells of it."""

    robot: Agent
    headset: Headset
    session: aiohttp.ClientSession
    base: str

    async def get(self, path: str) -> Any:
        async with self.session.get(self.base + path) as response:
            return await response.json()


@asynccontextmanager
async def look(site: Site, gateway: str, *, traces: bool = True) -> AsyncIterator[Look]:
    """At the robot, through the gateway of this name; ``traces``: whether it has the verb."""
    port = free_port()
    words = ("--settings", str(site.directory / gateway / "macs.toml"), "--port", "0", "--web-port", str(port))
    async with AsyncExitStack() as stack:
        entered = stack.enter_async_context
        agent = await entered(macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")))
        robot = Robot(agent)
        agent.serve("status", _status)
        if traces:
            agent.serve("trace", telling(agent))
        talking = asyncio.create_task(robot.chatter())
        stack.callback(talking.cancel)
        program = await entered(Program("gateway", *words))
        headset = await entered(await Headset.connect("127.0.0.1", program.port))
        session = await entered(aiohttp.ClientSession())
        found = Look(agent, headset, session, f"http://127.0.0.1:{port}")
        await until(lambda: (2, headset.id) in agent.directory)
        yield found


@pytest.mark.parametrize("gateway", ["hall-1", "hall-2"])
async def test_a_secured_mesh_s_page_shows_its_robot(site: Site, gateway: str) -> None:
    """Its state, and where the time of its topic goes: with the right to do everything, and with that to see it."""
    async with look(site, gateway) as at:
        topic = await at.headset.subscribe("/chatter", "std_msgs/String", agents=[7])

        async def told() -> bool:
            return bool(await at.get("/view/robots/7/status") == STATUS)

        await until(told, every_s=0.1)
        found: list[Any] = []

        async def traced() -> bool:
            found[:] = (await at.get("/view/trace/7?topic=/chatter"))["ways"]
            return bool(found)

        await until(traced, every_s=0.1)
        names = [hop["hop"] for hop in found[0]["hops"]]
        assert names[0] == "robot 7: into Zenoh"
        assert names[-1] == "this gateway: handled"
        assert any("router" in name for name in names), names
        assert found[0]["clocks_within_ms"]["robot 7"] is not None
        await topic.close()


async def test_commands_are_traced_on_a_secured_mesh(site: Site) -> None:
    """From the gateway to the robot, for a page of a gateway that may command it."""
    async with look(site, "hall-1") as at:
        publisher = await at.headset.advertise("/cmd", "std_msgs/String", agents=[7])

        async def traced() -> bool:
            for _ in range(5):
                await publisher.publish(b"\x00\x01\x00\x00\x02\x00\x00\x00x\x00", agents=[7])
            found = (await at.get("/view/trace/7?commands=1"))["ways"]
            return bool(found) and found[0]["hops"][-1]["hop"] == "robot 7: handled"

        await until(traced, every_s=0.05)


async def test_a_robot_that_tells_no_traces_is_named(site: Site) -> None:
    """One that does not know the verb, and may not be pinged: the page has it in words why it shows nothing."""
    async with look(site, "hall-2", traces=False) as at:
        topic = await at.headset.subscribe("/chatter", "std_msgs/String", agents=[7])
        said = await at.get("/view/trace/7?topic=/chatter")
        assert "it tells no traces" in said["error"]
        assert "macs security generate" in said["error"]
        await topic.close()


async def test_a_robot_tells_of_itself_only(router: str) -> None:
    """It marks nothing but what it sends, and of what it has noted tells what was sent to it; nor its losses."""
    async with (
        macs_zenoh.join("ros", id=7, settings=patient(router)) as robot,
        macs_zenoh.join("operator", id=5, settings=patient(router)) as eve,
    ):
        robot.serve("trace", telling(robot))

        async def asked(request: TraceRequest) -> TraceAnswer:
            answer = await eve.call("ros", 7, "trace", trace.encode_request(request), timeout_s=60)
            said, told = ping.decode(answer)
            assert said == ping.Pong(time_s=said.time_s)
            return trace.decode_answer(told)

        keys = (
            "macs/to/ros/0/7/unity/512",
            "macs/to/ros/0/70/unity/512",
            "macs/from/ros/8/nd__pose",
            "macs/all/ros/8",
        )
        for mark, key in enumerate(keys):
            robot.mesh.tracing.keep(key, mark, "loop", [])
        assert [report.key for report in (await asked(TraceRequest(put=trace.said_by(7)))).reports] == [keys[0]]
        assert list(robot.mesh.tracing.wanted) == ["macs/from/ros/7/"]
        for others in ("macs/", "macs/from/ros/8/", "macs/from/ros/70/", "macs/to/"):
            with pytest.raises(Refused, match="what it sends itself"):
                await asked(TraceRequest(put=others))
        with pytest.raises(MacsError):
            await eve.call("ros", 7, "trace", b"nonsense", timeout_s=60)
        assert list(robot.mesh.tracing.wanted) == ["macs/from/ros/7/"]
