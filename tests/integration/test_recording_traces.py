"""A recording has the way of traced messages, hop by hop."""

from __future__ import annotations

import asyncio
import json
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

import macs_zenoh
from bridge.graph.programs import Programs
from bridge.headset.client import Headset
from bridge.recording.bag import Bag
from bridge.recording.streams import NOTES, TRACES
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.trace import Offset
from tests.integration.test_trace import robot
from tests.support.programs import Program
from tests.support.waiting import PATIENCE_S, until

pytestmark = pytest.mark.timeout(120)


def told(file: Path, channel: str) -> list[dict[str, Any]]:
    with Bag(file) as bag:
        return [json.loads(message.data) for message in bag.messages(lambda each: each.topic == channel)]


async def test_traces_are_recorded(router: str, tmp_path: Path) -> None:
    """A robot's messages to a gateway's headset and to the recording, and a headset's commands to the robot: when each
    passed which point, as times that add up; of topics that are not recorded nothing."""
    file = tmp_path / "a.mcap"
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        await enter(robot(router))
        gateway = await enter(Program("gateway", "--port", "0", "-e", router))
        headset = await enter(await Headset.connect("127.0.0.1", gateway.port))
        heard = await headset.subscribe("/chatter", "std_msgs/String", agents=[7])
        await asyncio.wait_for(anext(heard), PATIENCE_S)
        orders = await headset.advertise("/cmd", "std_msgs/String", agents=[7])
        options = ("--compress", "none", "-e", router, "--traces", "1")
        await enter(Program("record", "--commands", "-o", str(file), *options))
        other = tmp_path / "other.mcap"
        await enter(Program("record", "--topics", "/other", "-o", str(other), *options))
        receiver = f"gateway 127.0.0.1:{gateway.port}"

        async def all_there() -> bool:
            await orders.publish(b"\0\1\0\0\1\0\0\0\0")
            read = file.read_bytes()
            topic = '"topic":"/chatter","to"'  # commands may have been traced to here as well
            wanted = ('"to":"robot 7"', f'{topic}:"{receiver}"', f'{topic}:"here"')
            return all(each.encode() in read for each in wanted)

        await until(all_there, PATIENCE_S, every_s=0.05)
    traces = told(file, TRACES)
    topics = [each for each in traces if "topic" in each]
    assert {(each["robot"], each["topic"]) for each in topics} == {(7, "/chatter")}
    assert {each["to"] for each in topics} == {receiver, "here"}
    commands = [each for each in traces if "topic" not in each]
    assert {(each["robot"], each["commands_of"]) for each in commands} == {(7, f"unity/{headset.id}")}
    assert {"robot 7"} <= {each["to"] for each in commands} <= {"robot 7", "here"}
    for each in traces:
        hops = [hop["hop"] for hop in each["hops"]]
        assert hops[0] == ("robot 7: into Zenoh" if "topic" in each else f"{receiver}: gateway")
        assert hops[-1] == f"{each['to']}: handled"
        assert sum(hop["ms"] for hop in each["hops"]) == pytest.approx(each["ms"], abs=0.01)
        assert None not in each["clocks_within_ms"].values()
    assert told(other, TRACES) == []


async def test_who_tells_nothing_is_named_once(router: str, tmp_path: Path) -> None:
    """A robot whose session answers no pings: a note says so."""
    file = tmp_path / "a.mcap"
    async with macs_zenoh.join("ros", id=7, connect=[router]) as silent:
        silent.mesh.tracing.answer = lambda asked: b"no answer"  # type: ignore[method-assign]
        async with Program("record", "--compress", "none", "-o", str(file), "-e", router, "--traces", "1"):
            await until(lambda: b"not_traced" in file.read_bytes(), every_s=0.1)
    assert [note["not_traced"] for note in told(file, NOTES) if "not_traced" in note] == ["robot 7"]


@pytest.mark.parametrize("time_s", [1e300, -1e300])
async def test_a_clock_that_is_none_is_not_known(router: str, time_s: float) -> None:
    """A program's clock that is further away than any: it is taken for one that is not known."""
    async with macs_zenoh.join("unity", connect=[router]) as agent:
        programs = Programs(agent.mesh, 2.0)

        async def pong(zid: str) -> ping.Pong:
            return ping.Pong(time_s=time_s)

        programs.pong = pong  # type: ignore[method-assign]
        assert await programs.clock("another") == Offset()
