"""`macs top`, `macs watch`, `macs ping` and `macs bench` on a real mesh, without ROS."""

from __future__ import annotations

import asyncio
import json
import socket
import sys
from contextlib import AsyncExitStack
from typing import Any

import pytest

import macs_zenoh
from bridge.headset.client import Headset
from macs_zenoh.config import MeshSettings
from macs_zenoh.protocol.greetings import INIT_SYN
from tests.support.links import delayed
from tests.support.processes import ROOT
from tests.support.programs import Program, ended, free_port, macs
from tests.support.routers import Router
from tests.support.terminals import terminal
from tests.support.waiting import PATIENCE_S, until

STATE: dict[str, Any] = {
    "ros_node": "/rosagent",
    "stopped": False,
    "stop": {"by": "", "pressed": [], "seconds": 0, "times": 0, "history": []},
    "nodes": [
        {
            "role": "subscriber",
            "name": "/pose",
            "type": "geometry_msgs/msg/PoseStamped",
            "registrants": ["unity/2"],
            "carried": {"messages": 10, "bytes": 800, "age_s": 0.1},
        }
    ],
    "drops": {},
}


class Told:
    """A robot that tells a state, which the test changes."""

    def __init__(self, agent: macs_zenoh.Agent) -> None:
        self.state = json.loads(json.dumps(STATE))
        self.asked = 0
        agent.serve("status", self._answer)

    async def _answer(self, call: macs_zenoh.Call) -> bytes:
        self.asked += 1
        self.state["nodes"][0]["carried"]["messages"] += 5
        return json.dumps(self.state).encode()


async def test_watch_tells_what_changes(router: str) -> None:
    """A line for each: who comes and leaves, a stop and its release, what was refused, a gateway."""
    async with macs_zenoh.join("ros", id=7, connect=[router]) as agent:
        robot = Told(agent)
        watching = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "bridge", "watch", "--json", "--count", "7", "-e", router),
            cwd=ROOT,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        assert watching.stdout is not None
        assert watching.stderr is not None

        async def event() -> dict[str, Any]:
            said: dict[str, Any] = json.loads(await asyncio.wait_for(watching.stdout.readline(), PATIENCE_S))
            return said

        while b"watching" not in (line := await asyncio.wait_for(watching.stderr.readline(), PATIENCE_S)):
            assert line
        async with macs_zenoh.join("unity", id=300, group=3, connect=[router]):
            assert (await event()) | {"time": 0} == {
                "time": 0,
                "event": "came",
                "who": "unity/300",
                "text": f"unity/300 is online in group 3 (session {_short(agent, 300)})",
            }
            robot.state["stopped"], robot.state["stop"]["by"], robot.state["stop"]["times"] = True, "unity/300", 1
            said = await event()
            assert (said["event"], said["who"], said["by"]) == ("stopped", "ros/7", "unity/300")
            robot.state["drops"]["stopped"] = 2
            assert (await event())["text"] == "ros/7 refused 2 messages: the emergency stop holds (stopped)"
            robot.state["stopped"] = False
            assert (await event())["event"] == "released"
        assert (await event())["event"] == "left"
        endpoint = router
        async with Program("gateway", "--port", "0", "-e", endpoint) as gateway:
            assert (await event())["who"] == gateway.ready.replace("gateway on", "gateway")
            with socket.create_connection(("127.0.0.1", gateway.port)) as wrong:  # a Zenoh program, as it dials
                wrong.sendall(INIT_SYN)
                said = await event()
            assert said["event"] == "refused"
            assert said["text"].endswith("they are Zenoh programs, which want a router (zenoh_program)")
        assert await asyncio.wait_for(watching.wait(), PATIENCE_S) == 0


def _short(agent: macs_zenoh.Agent, number: int) -> str:
    found = agent.directory.get(2, number)
    assert found is not None
    return found.zid[:8]


async def test_watch_ends_as_it_was_told(router: str) -> None:
    """Too few events in time are exit code 1; an event that there is not is wrong usage."""
    code, out, _ = await ended("watch", "-e", router, "--count", "1", "--timeout", "0.3")
    assert (code, out) == (1, "")
    code, _, log = await ended("watch", "-e", router, "--only", "stoped")
    assert (code, "'stoped' is no event" in log) == (2, True)


async def test_top_shows_all_of_a_mesh(router: str) -> None:
    """For programs and as a page: robots, topics with rates, headsets with address and age, gateways and routers."""
    async with (
        macs_zenoh.join("ros", id=7, group=3, connect=[router]) as agent,
        Program("gateway", "--port", "0", "-e", router) as gateway,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
    ):
        robot = Told(agent)
        await until(lambda: agent.directory.get(2, headset.id))
        said = await macs("top", "--json", "-e", router)
        (row,) = said["robots"]
        assert (row["id"], row["group"], row["stopped"], row["state"]) == (7, 3, False, "")
        (topic,) = said["topics"]
        assert (topic["robot"], topic["topic"], topic["way"], topic["registrants"]) == (7, "/pose", "out", ["unity/2"])
        assert topic["rate_hz"] > 0
        (worn,) = [row for row in said["headsets"] if row["id"] == headset.id]
        assert worn["address"].startswith("127.0.0.1:")
        assert worn["age_s"] >= 0
        kinds = {row["kind"]: row for row in said["programs"]}
        assert kinds["gateway"]["address"] == f"127.0.0.1:{gateway.port}"
        assert kinds["router"]["round_trip_ms"] > 0
        assert robot.asked <= 5

        code, page, _ = await ended("top", "--once", "--view", "headsets", "-e", router)
        assert code == 0
        assert page.splitlines()[0].startswith(f"macs top {router}  1 robots")
        assert f"127.0.0.1:{worn['address'].rpartition(':')[2]}" in page


async def test_top_fills_a_terminal_of_80_by_24(router: str) -> None:
    """It draws, follows keys, and leaves the terminal as it was."""
    async with macs_zenoh.join("ros", id=7, connect=[router]) as agent:
        Told(agent)
        async with terminal("top", "-e", router) as shown:
            await until(lambda: b"1 robots 2 topics" in shown.seen and b"ROBOT" in shown.seen)
            shown.type(b"2")
            await until(lambda: b"/pose" in shown.seen and b"CONTROL" in shown.seen)
            shown.type(b"q")
            assert await shown.ended() == 0
            await until(lambda: b"\x1b[?1049l" in shown.seen)
            assert shown.settings == shown.before


async def test_top_shows_which_routers_are_linked() -> None:
    """Two in a row, each with the other, whichever is asked."""
    async with Router() as first, Router(connect=[first.endpoint]) as second:

        async def linked() -> bool:
            said = await macs("top", "--json", "-e", second.endpoint)
            routers = {row["zid"]: row["links"] for row in said["programs"] if row["kind"] == "router"}
            return len(routers) == 2 and all(set(links) == routers.keys() - {zid} for zid, links in routers.items())

        await until(linked, every_s=0.2)


async def test_top_shows_how_long_each_link_takes() -> None:
    """A link that takes 100 ms longer in either direction is the one that is shown to: what it is to its far end, less
    what it is to its near one. Those of the robot and of the gateway are not. In a namespace as well."""
    async with AsyncExitStack() as stack:
        first = await stack.enter_async_context(Router())
        slow = await stack.enter_async_context(delayed(first.endpoint, 0.1))
        second = await stack.enter_async_context(Router(connect=[slow]))
        words = ("--namespace", "hall")
        settings = MeshSettings(connect=[first.endpoint], namespace="hall")
        robot = await stack.enter_async_context(macs_zenoh.join("ros", id=7, settings=settings))

        async def status(call: macs_zenoh.Call) -> bytes:
            return json.dumps(STATE).encode()

        robot.serve("status", status)
        argv = ("gateway", "--port", "0", "-e", second.endpoint, *words)
        await stack.enter_async_context(Program(*argv))

        async def timed() -> bool:
            said = await macs("top", "--json", "-e", second.endpoint, *words)
            rows = {row["kind"]: row for row in said["programs"] if row["link"] or row["kind"] == "router"}
            routers = [row for row in said["programs"] if row["kind"] == "router"]
            of_routers = [took for row in routers for took in row["links_ms"].values()]
            behind = said["robots"][0]["link"] if said["robots"] else None
            if len(of_routers) != 2 or None in of_routers or "gateway" not in rows or behind is None:
                return False
            near, far = sorted(row["round_trip_ms"] for row in routers)
            assert far >= 200
            assert of_routers == pytest.approx([far - near] * 2, abs=0.01)
            assert rows["gateway"]["link"]["router"] != behind["router"]
            took = (behind["round_trip_ms"], rows["gateway"]["link"]["round_trip_ms"])
            return None not in took and max(took) < 100 < of_routers[0]  # of one answer a busy machine may make more

        await until(timed, every_s=0.2)


async def test_ping_says_how_long_a_robot_takes(router: str) -> None:
    """Times, losses and the clock; a robot that is not online is exit code 1."""
    async with macs_zenoh.join("ros", id=7, connect=[router]):
        said = await macs("ping", "7", "--count", "3", "--interval", "0.01", "--json", "-e", router)
        assert (said["robot"], said["sent"], said["answered"]) == (7, 3, 3)
        assert 0 < said["min_ms"] <= said["p50_ms"] <= said["p99_ms"] <= said["max_ms"]
        assert abs(said["clock_ahead_ms"]) <= said["clock_within_ms"]
        code, out, _ = await ended("ping", "7", "--count", "1", "-e", router)
        assert code == 0
        assert out.startswith("56 bytes from robot 7: seq=1 time=")
        assert "1 sent, 1 answered, 0% lost\nrtt min/avg/max/mdev = " in out
    code, _, log = await ended("ping", "9", "-e", router)
    assert (code, "robot 9 cannot be reached: it is not online" in log) == (1, True)


async def test_bench_measures_and_is_bounded(router: str) -> None:
    """Through the router and to a robot's agent; more than a mesh should be asked for is refused."""
    said = await macs("bench", "--seconds", "0.5", "--rate", "100", "--json", "-e", router)
    assert (said["sent"], said["lost"]) == (50, 0)
    assert 0 < said["p50_ms"] <= said["p99_ms"]
    async with macs_zenoh.join("ros", id=7, connect=[router]):
        bench = ("bench", "--robot", "7", "--seconds", "0.3", "--rate", "50", "-e", router)
        code, out, _ = await ended(*bench)
        assert code == 0
        assert out.startswith("robot 7, there and back: 15 messages of 1000 bytes")
        assert (await ended(*bench, "--most-ms", "0.000001"))[0] == 1
    for wrong, why in (
        (("--rate", "1e6"), "rate"),
        (("--seconds", "3600"), "seconds"),
        (("--rate", "2000", "--size", "100000"), "at most 10 MB/s"),
    ):
        code, _, log = await ended("bench", "-e", router, *wrong)
        assert code == 2
        assert why in log.splitlines()[-1]
    code, _, log = await ended("bench", "-e", f"tcp/127.0.0.1:{free_port()}", "--wait", "0.3")
    assert code == 1
