"""Messages traced on a real mesh: a robot, two routers in a row, a gateway and a headset. Without ROS."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import pytest

import macs_zenoh
from bridge.headset.client import Headset
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.protocol import trace
from macs_zenoh.protocol.messages import AddNode, Metadata, NodeType, StreamData, decode_data, encode_management
from macs_zenoh.protocol.trace import ROS_SENT, TAKEN, Point, TraceRequest
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams
from tests.support.links import counted, delayed
from tests.support.programs import Program, ended
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

OFFERS = {
    "publishers": {"/chatter": "std_msgs/msg/String"},
    "subscribers": {"/cmd": "std_msgs/msg/String"},
    "services": {},
}
NODE = "nd__chatter"
INJECTED_S = 0.02


class Robot:
    """Registers who asks, and publishes its topic fifty times a second."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.registrants: set[int] = set()
        self._streams = Streams(agent)
        agent.serve("add_node", self._add)
        agent.serve("remove_node", self._nothing)
        agent.serve("offers", self._offers)
        agent.serve("definitions", self._nothing)

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        self.registrants.add(decode_data(AddNode, call.data).registrant_agent_id)
        return b""

    async def _nothing(self, call: macs_zenoh.Call) -> bytes:
        return b""

    async def _offers(self, call: macs_zenoh.Call) -> bytes:
        return json.dumps(OFFERS).encode()

    async def chatter(self) -> None:
        metadata = Metadata(1, self.agent.id, 0, StreamData.manager, NodeType.SUBSCRIBER, NODE, "std_msgs/String")
        while True:
            management = encode_management(StreamData({"2": sorted(self.registrants)}))
            text = encode_message(metadata.encode(), b"\x00\x01\x00\x00\x06\x00\x00\x00hello\x00")
            self._streams.publish(NODE, encode_frame(1, management=management, message=text))
            await asyncio.sleep(0.02)


@asynccontextmanager
async def robot(endpoint: str) -> AsyncIterator[Robot]:
    async with macs_zenoh.join("ros", id=7, connect=[endpoint]) as agent:
        robot = Robot(agent)
        talking = asyncio.create_task(robot.chatter())
        try:
            yield robot
        finally:
            talking.cancel()


async def traced(endpoint: str, *options: str) -> list[dict[str, Any]]:
    """What `macs trace` says, an object for each way."""
    code, out, log = await ended("trace", "/chatter", "--robot", "7", "--json", "-e", endpoint, *options)
    assert code == 0, log
    return [json.loads(line) for line in out.splitlines()]


@pytest.mark.parametrize("where", ["to the router", "between the routers", "to the gateway"])
async def test_what_is_injected_at_a_hop_is_shown_there(where: str) -> None:
    """From the robot's put to the gateway's sockets, two routers in a row as two, every hop with its name, and all of
    them the whole; what a link takes longer is shown at that hop for each of a hundred messages, and nowhere else."""
    async with AsyncExitStack() as stack:

        async def reached(endpoint: str, name: str) -> str:
            """A router, behind a relay that takes its time where that is wanted."""
            return await stack.enter_async_context(delayed(endpoint, INJECTED_S)) if where == name else endpoint

        first = await stack.enter_async_context(Router())
        dialled = await reached(first.endpoint, "between the routers")
        second = await stack.enter_async_context(Router(connect=[dialled]))
        talking = await stack.enter_async_context(robot(await reached(first.endpoint, "to the router")))
        argv = ("gateway", "--port", "0", "-e", await reached(second.endpoint, "to the gateway"))
        gateway = await stack.enter_async_context(Program(*argv))
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        subscription = await headset.subscribe("/chatter", "std_msgs/String", agents=[7])
        await asyncio.wait_for(anext(subscription), PATIENCE_S)
        ways = await traced(second.endpoint, "--count", "100", "--seconds", "60")
        receiver = f"gateway 127.0.0.1:{gateway.port}"
        (way,) = [way for way in ways if way["receiver"] == receiver]
        assert way["count"] >= 100
        names = [hop["hop"] for hop in way["hops"]]
        places = {
            "to the router": next(name for name in names if name.startswith("robot 7 to router")),
            "between the routers": next(name for name in names if name.startswith("router") and " to router" in name),
            "to the gateway": next(name for name in names if name.endswith(f"to {receiver}")),
        }
        assert (names[0], names[-1]) == ("robot 7: into Zenoh", f"{receiver}: handled")
        total = sum(hop["mean_ms"] for hop in way["hops"])
        assert total == pytest.approx(way["end_to_end"]["mean_ms"], rel=0.05, abs=0.1)
        assert [hop["hop"] for hop in way["hops"] if hop["min_ms"] >= 1000 * INJECTED_S] == [places[where]]
        assert all(bound is not None for bound in way["clocks_within_ms"].values())
        assert talking.registrants >= {headset.id}


async def test_what_takes_long_in_a_program_is_shown_there(router: str) -> None:
    """Before Zenoh has it, by what the sender notes; behind Zenoh, by what the receiver does with it."""
    async with (
        await Mesh.open(MeshSettings(connect=[router])) as mesh,
        await Mesh.open(MeshSettings(connect=[router])) as other,
    ):
        came: list[bytes] = []

        def take(batch: Any) -> None:
            for _, payload in batch:
                time.sleep(INJECTED_S)
                came.append(bytes(payload))

        subscription = other.subscribe("macs/from/**", take)
        await until(lambda: (mesh.put("macs/from/ros/7/nd__x", b"", Traffic.STREAM), came)[1])
        other.tracing.answer(trace.encode_request(TraceRequest(seconds=60)))
        mesh.tracing.answer(trace.encode_request(TraceRequest(put="macs/from/ros/7/", look=False, seconds=60)))
        for number in range(100):
            now_ns = time.time_ns()
            mesh.tracing.note((ROS_SENT, now_ns - int(2e9 * INJECTED_S)), (TAKEN, now_ns - int(1e9 * INJECTED_S)))
            mesh.put("macs/from/ros/7/nd__x", b"%d" % number, Traffic.STREAM)
            await until(lambda number=number: b"%d" % number in came)
        reports = trace.decode_answer(other.tracing.answer(trace.encode_request(TraceRequest()))).reports
        assert len(reports) == 100
        for report in reports:
            points = [Point(*point) for point in report.points]
            taken = {hop.name: hop.took_ns / 1e9 for hop in trace.hops(points, {mesh.zid: "a", other.zid: "b"})}
            assert sum(took_s >= INJECTED_S for took_s in taken.values()) >= 3
            for name in ("a: ROS to its agent", "a: agent", "b: handled"):
                assert taken[name] >= INJECTED_S, taken
        subscription.close()


async def test_commands_are_traced_the_other_way(router: str) -> None:
    """From the headset's socket to the robot; what has not the priority of commands is not marked."""
    async with (
        robot(router),
        Program("gateway", "--port", "0", "-e", router) as gateway,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
    ):
        publisher = await headset.advertise("/cmd", "std_msgs/String", agents=[7])

        async def drive() -> None:
            while True:
                await publisher.publish(b"\x00\x01\x00\x00\x02\x00\x00\x00x\x00", agents=[7])
                await asyncio.sleep(0.02)

        driving = asyncio.create_task(drive())
        try:
            (way,) = await traced(router, "--commands", "--count", "20", "--seconds", "60")
        finally:
            driving.cancel()
        names = [hop["hop"] for hop in way["hops"]]
        assert names[0] == f"gateway 127.0.0.1:{gateway.port}: gateway"
        assert names[-1] == "robot 7: handled"


async def test_off_it_costs_no_byte(router: str) -> None:
    """What is put is as large on the wire as before anybody asked, as soon as nobody asks any more."""
    async with (
        counted(router) as link,
        await Mesh.open(MeshSettings(connect=[link.endpoint])) as mesh,
        await Mesh.open(MeshSettings(connect=[router])) as other,
    ):
        came: list[bytes] = []
        subscription = other.subscribe("macs/from/**", lambda batch: came.extend(bytes(each) for _, each in batch))

        async def sent() -> int:
            """Bytes on the wire for a hundred messages."""
            before, link_before = len(came), link.up_bytes
            for _ in range(100):
                mesh.put("macs/from/ros/7/nd__x", bytes(200), Traffic.STREAM)
                await asyncio.sleep(0.001)
            await until(lambda: len(came) >= before + 100)
            return link.up_bytes - link_before

        await until(lambda: (mesh.put("macs/from/ros/7/nd__x", b"", Traffic.STREAM), came)[1])
        await sent()
        off = await sent()
        mesh.tracing.answer(trace.encode_request(TraceRequest(put="macs/from/ros/7/", seconds=60)))
        on = await sent()
        assert on > off + 100 * 30
        mesh.tracing.end(float("inf"))
        assert not mesh.tracing.wanted
        again = await sent()
        assert abs(again - off) < 400  # a beat of the session may fall into one of them
        subscription.close()


async def test_one_in_so_many_is_always_traced_if_wanted(router: str) -> None:
    """`trace_every` marks topic data and notes it where it comes; others are left alone."""
    settings = MeshSettings(connect=[router], trace_every=10)
    async with await Mesh.open(settings) as mesh, await Mesh.open(settings) as other:
        came: list[bytes] = []
        subscription = other.subscribe("macs/**", lambda batch: came.extend(bytes(each) for _, each in batch))
        await until(lambda: (mesh.put("macs/from/ros/7/nd__x", b"", Traffic.STREAM), came)[1])
        before = len(trace.decode_answer(other.tracing.answer(trace.encode_request(TraceRequest()))).reports)
        for number in range(1, 101):
            mesh.put("macs/from/ros/7/nd__x", b"x", Traffic.STREAM)
            mesh.put("macs/to/ros/0/7/unity/2", b"y", Traffic.COMMAND)
            # a busy machine drops of many at once
            await until(lambda: came.count(b"x") == came.count(b"y") == number)  # noqa: B023
        reports = trace.decode_answer(other.tracing.answer(trace.encode_request(TraceRequest()))).reports
        assert len(reports) - before == 10
        assert {report.key for report in reports} == {"macs/from/ros/7/nd__x"}
        for _ in range(20):  # what tells how much there was is no topic data
            await until(lambda: mesh.streams.put_here("macs/from/ros/7/nd__x", b"z", traced=False))
        await until(lambda: (mesh.put("macs/to/ros/0/7/unity/2", b"end", Traffic.COMMAND), b"end" in came)[1])
        again = trace.decode_answer(other.tracing.answer(trace.encode_request(TraceRequest()))).reports
        assert len(again) == len(reports)
        subscription.close()


async def test_nonsense_is_answered_with_nothing(router: str) -> None:
    """Whoever pings with what is no request gets no traces, and nothing is marked."""
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh:
        for wrong in (b"", b"{", b'{"every": 0}', b'{"put": 3}', b"x" * 5000):
            assert trace.decode_answer(mesh.tracing.answer(trace.PREFIX + wrong)).reports == []
        assert not mesh.tracing.wanted
        for number in range(200):
            mesh.tracing.answer(trace.encode_request(TraceRequest(put=f"key{number}")))
        assert len(mesh.tracing.wanted) <= 64


async def test_what_was_noted_before_is_not_told(router: str) -> None:
    """A trace is of messages that come while somebody looks, whoever had others traced before."""
    async with (
        robot(router),
        Program("gateway", "--port", "0", "-e", router) as gateway,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
    ):
        subscription = await headset.subscribe("/chatter", "std_msgs/String", agents=[7])
        await asyncio.wait_for(anext(subscription), PATIENCE_S)
        await traced(router, "--count", "30", "--seconds", "60")
        receiver = f"gateway 127.0.0.1:{gateway.port}"
        ways = await traced(router, "--seconds", "0.3")
        counts = [way["count"] for way in ways if way["receiver"] == receiver]
        assert all(count < 30 for count in counts), counts
