"""The verbs as real processes: they start in any order, are listed, and stop on a signal."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path

import pytest

import macs_zenoh
from bridge.headset.client import Headset
from tests.support.programs import ROOT, Program, ended, free_port, macs
from tests.support.thorough import some
from tests.support.waiting import PATIENCE_S


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


async def test_ls_lists_robots_and_headsets(endpoint: str) -> None:
    """Everybody online is in `macs ls --json`, with type, id and group."""
    async with (
        Program("router", "-l", endpoint),
        Program("gateway", "--port", "0", "-e", endpoint) as gateway,
        macs_zenoh.join("ros", id=7, group=3, connect=[endpoint]),
        await Headset.connect("127.0.0.1", gateway.port, group=4) as headset,
    ):
        while 7 not in (await headset.online()).ros_agent_ids:
            await asyncio.sleep(0.02)
        listed = await macs("ls", "--json", "-e", endpoint)
        assert [(agent["type"], agent["id"], agent["group"]) for agent in listed] == [
            ("ros", 7, 3),
            ("unity", headset.id, 4),
        ]
        code, shown, _ = await ended("ls", "-e", endpoint)
        assert code == 0
        agents, _, others = shown.partition("\n\n")
        assert [line.split()[:3] for line in agents.splitlines()] == [
            ["TYPE", "ID", "GROUP"],
            ["ros", "7", "3"],
            ["unity", str(headset.id), "4"],
        ]
        here, there = others.splitlines()
        assert here.split()[0] == "gateway"
        assert here.split()[2:5] == [f"127.0.0.1:{gateway.port}", "1", "agents"]
        assert there.split()[0] == "router"
        assert there.split()[2] == endpoint
        everything = await macs("ls", "--json", "-v", "-e", endpoint)
        (of_gateway,) = (row for row in everything if row["type"] == "gateway")
        assert (of_gateway["address"], of_gateway["agents"]) == (f"127.0.0.1:{gateway.port}", 1)
        assert of_gateway["macs"]
        assert of_gateway["zid"] == next(row["zid"] for row in everything if row["type"] == "unity")
        assert [row["addresses"] for row in everything if row["type"] == "router"] == [[endpoint]]
        assert all(len(row["zid"]) > 24 for row in everything)
        assert not [word for word in shown.split() if len(word) > 24 and word.isalnum()], "ids are short for people"


async def test_ls_of_an_empty_mesh_is_an_empty_list(endpoint: str) -> None:
    """A router with nobody on it is no failure."""
    async with Program("router", "-l", endpoint):
        assert await macs("ls", "--json", "-e", endpoint) == []


async def test_ls_without_a_router_is_exit_code_1(endpoint: str) -> None:
    """When no router answers, one line says so."""
    code, out, errors = await ended("ls", "-e", endpoint, "--timeout", "0.5")
    assert (code, out) == (1, "")
    assert errors.startswith(f"macs ls: {endpoint} cannot be reached")
    assert len(errors.splitlines()) == 1


async def test_a_namespace_is_a_mesh_of_its_own(endpoint: str) -> None:
    """Programs in one namespace do not see those of another on the same router."""
    site = macs_zenoh.MeshSettings(connect=[endpoint], namespace="site1")
    async with Program("router", "-l", endpoint), macs_zenoh.join("ros", id=7, settings=site):
        assert await macs("ls", "--json", "-e", endpoint) == []
        assert [agent["id"] for agent in await macs("ls", "--json", "-e", endpoint, "--namespace", "site1")] == [7]
        _, shown, _ = await ended("ls", "-e", endpoint)
        assert shown.startswith("nobody is online here; 1 in 'site1' (--namespace site1)\n")
        for argv in (["topic", "list"], ["service", "list"], ["topic", "info", "/pose", "--robot", "7"]):
            code, _, errors = await ended(*argv, "-e", endpoint)
            assert code == 1
            assert "online here; 1 in 'site1' (--namespace site1) (macs ls)" in errors
        for argv in (["topic", "echo", "/pose"], ["service", "call", "/set", "data: true"], ["ping", "7"]):
            code, _, errors = await ended(*argv, "-e", endpoint)
            assert (code, "online here; 1 in 'site1' (--namespace site1) (macs ls)" in errors) == (1, True), errors
        code, said, _ = await ended("stop", "-e", endpoint)
        assert (code, said) == (1, "no such robot is online here; 1 in 'site1' (--namespace site1)\n")


@pytest.mark.alone
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
async def test_servers_stop_on_a_signal(endpoint: str, number: signal.Signals) -> None:
    """Router and gateway end with 0 within 2 s, the gateway also when its router is gone before it."""
    router = Program("router", "-l", endpoint)
    gateway = Program("gateway", "--port", "0", "-e", endpoint)
    async with router, gateway:
        assert await asyncio.wait_for(router.stop(number), 2) == 0
        assert await asyncio.wait_for(gateway.stop(number), 2) == 0


@pytest.mark.parametrize("workers", [["--workers", "2"], ["--workers=2"]], ids=" ".join)
async def test_a_worker_starts_no_workers(router: str, workers: list[str]) -> None:
    """However it is spelled: as many processes as were asked for, and each serves the one port."""
    async with Program("gateway", *workers, "-v", "--port", "0", "-e", router) as gateway:
        assert {len(children_of(pid)) for pid in children_of(gateway.pid)} == {0}
        assert len(children_of(gateway.pid)) == 2
        async with await Headset.connect("127.0.0.1", gateway.port) as headset:
            assert headset.id in (await headset.online()).unity_agent_ids


def children_of(pid: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(stat.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(stat.parent.name))
    return found


HOSTS = [
    ("::", "[::]", ["127.0.0.1", "::1"]),
    ("[::]", "[::]", ["127.0.0.1", "::1"]),
    ("::1", "[::1]", ["::1"]),
    ("0.0.0.0", "0.0.0.0", ["127.0.0.1"]),
    ("localhost", "localhost", ["127.0.0.1"]),
]
"""What a gateway is told, what it says, and where it is found."""


@pytest.mark.parametrize(
    ("host", "shown", "dialled", "workers"),
    [(*host, []) for host in HOSTS] + [(*host, ["--workers", "2"]) for host in some(HOSTS)],
)
async def test_where_a_gateway_listens_can_be_pasted(
    router: str, host: str, shown: str, dialled: list[str], workers: list[str]
) -> None:
    """`::` is both families, with and without brackets; what `ready:` says is what `macs headset` takes."""
    async with Program("gateway", "--host", host, "--port", "0", "-e", router, *workers) as gateway:
        where = gateway.ready.removeprefix("gateway on ")
        assert where == f"{shown}:{gateway.port}"
        assert (await macs("headset", where, "online"))["ros"] == []
        for address in dialled:
            async with await Headset.connect(address, gateway.port) as headset:
                assert headset.target == (f"[{address}]" if ":" in address else address) + f":{gateway.port}"


@pytest.mark.parametrize(
    ("first", "then"), [([], ["--workers", "2"]), (["--workers", "2"], []), (["--workers", "2"], ["--workers", "3"])]
)
async def test_a_port_is_free_when_its_gateway_is_gone(router: str, first: list[str], then: list[str]) -> None:
    """A gateway that closed its connections leaves no port that others cannot have for a minute."""
    async with Program("gateway", "--port", "0", "-e", router, *first) as gateway:
        port = gateway.port
        headsets = [await Headset.connect("127.0.0.1", port) for _ in range(4)]
        await gateway.stop()
        for headset in headsets:
            await headset.close()
    async with (
        Program("gateway", "--port", str(port), "-e", router, *then),
        await Headset.connect("127.0.0.1", port) as headset,
    ):
        assert (await headset.online()).unity_agent_ids == [headset.id]


@pytest.mark.parametrize("first", [[], ["--workers", "2"]], ids=["alone", "workers"])
async def test_workers_share_with_no_other_gateway(router: str, first: list[str]) -> None:
    """A port of another gateway is taken, also of one that shares it among its own workers."""
    async with Program("gateway", "--port", "0", "-e", router, *first) as gateway:
        for second in ([], ["--workers", "2"]):
            code, out, errors = await ended("gateway", "--port", str(gateway.port), "-e", router, *second)
            assert (code, out) == (1, "")
            assert f"127.0.0.1:{gateway.port} cannot be reached: cannot listen there" in errors.splitlines()[-1]


async def test_a_gateway_waits_for_its_router(endpoint: str) -> None:
    """Started first, a gateway says what it waits for, and works once the router is there."""
    gateway = Program("gateway", "--port", "0", "-e", endpoint)
    start = asyncio.create_task(gateway.start())
    while not any(endpoint in line for line in gateway.log):
        await asyncio.sleep(0.02)
    assert not start.done()
    async with Program("router", "-l", endpoint):
        await start
        assert await gateway.stop() == 0


async def test_a_waiting_gateway_stops_too(endpoint: str) -> None:
    """SIGTERM ends a gateway that still waits for a router."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "bridge",
        "gateway",
        "--port",
        "0",
        "-e",
        endpoint,
        cwd=ROOT,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stderr is not None
    assert endpoint in (await asyncio.wait_for(process.stderr.readline(), PATIENCE_S)).decode()
    process.send_signal(signal.SIGTERM)
    assert await asyncio.wait_for(process.wait(), PATIENCE_S) == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
@pytest.mark.parametrize("verb", ["ls", "stop"])
async def test_an_interrupted_question_is_130(verb: str, number: signal.Signals) -> None:
    """Who was to find or do something and was stopped before ends with 130, without a word."""
    with socket.create_server(("127.0.0.1", 0)) as says_nothing:
        says_nothing.setblocking(False)
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "bridge", verb, "--timeout", "60"),
            *("-e", f"tcp/127.0.0.1:{says_nothing.getsockname()[1]}"),
            cwd=ROOT,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        begun, _ = await asyncio.wait_for(asyncio.get_running_loop().sock_accept(says_nothing), PATIENCE_S)
        process.send_signal(number)
        begun.close()
    assert await asyncio.wait_for(process.communicate(), PATIENCE_S) == (b"", b"")
    assert process.returncode == 130


async def test_a_taken_port_is_one_line(endpoint: str) -> None:
    """A router or gateway that cannot listen says where and ends with 1."""
    async with Program("router", "-l", endpoint), Program("gateway", "--port", "0", "-e", endpoint) as gateway:
        for argv, where in (
            (["router", "-l", endpoint], endpoint),
            (["gateway", "--port", str(gateway.port), "-e", endpoint], str(gateway.port)),
        ):
            code, _, errors = await ended(*argv)
            assert code == 1
            assert "Traceback" not in errors
            assert where in errors.splitlines()[-1]


@pytest.mark.alone
async def test_up_runs_router_and_gateway(endpoint: str) -> None:
    """`macs up` without a robot's ROS side still serves headsets, and stops all its programs within 2 s."""
    port, router_port = free_port(), free_port()
    # rclpy is hidden by an empty package of its name without an import path to the real one
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        "import sys, importlib.util as u; real = u.find_spec;"
        "u.find_spec = lambda name, *rest: None if name == 'rclpy' else real(name, *rest);"
        "from bridge.cli import main; sys.exit(main())",
        *("up", "--port", str(port), "--router-port", str(router_port)),
        cwd=ROOT,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    shown = b""
    while b"A Unity headset connects" not in shown:
        line = await asyncio.wait_for(process.stdout.readline(), PATIENCE_S)
        assert line, (await process.communicate())[1].decode()
        shown += line
    async with await Headset.connect("127.0.0.1", port) as headset:
        assert (await headset.online()).unity_agent_ids == [headset.id]
        assert len(await macs("ls", "--json", "-e", f"tcp/127.0.0.1:{router_port}")) == 1
    process.send_signal(signal.SIGINT)
    _, errors = await asyncio.wait_for(process.communicate(), 2)
    assert process.returncode == 0
    assert "no rclpy here, so no robot" in errors.decode()
    assert "killed" not in errors.decode()


async def test_up_once_gives_up() -> None:
    """`macs up --demo --once` with a router that is not there fails, and says what was not ready."""
    pytest.importorskip("rclpy")
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", "import sys; from bridge.cli import main, up; up.READY_S = 3.0; sys.exit(main())"),
        *("up", "--demo", "--once", "--port", "0", "-e", nowhere),
        cwd=ROOT,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    _, errors = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert process.returncode == 1
    last = errors.decode().splitlines()[-1]
    assert last == f"macs up: not ready within 3 s: gateway, agent; is there a router at {nowhere}?"


async def test_keys_as_a_program() -> None:
    """`macs keys --json` is JSON and needs no router."""
    code, out, _ = await ended("keys", "--json")
    assert code == 0
    assert json.loads(out)


async def test_zenohs_log_stays_out_of_the_data(endpoint: str) -> None:
    """With Zenoh's log on, which goes to descriptor 1, the ready line is the first and JSON is JSON."""
    logging = {"RUST_LOG": "zenoh=debug"}
    async with Program("router", "-l", endpoint, env=logging) as router:
        assert router.ready == f"router on {endpoint}"
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            *("-m", "bridge", "ls", "--json", "-e", endpoint),
            cwd=ROOT,
            env={**os.environ, **logging},
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        out, errors = await asyncio.wait_for(process.communicate(), PATIENCE_S)
        assert json.loads(out) == []
        assert b"DEBUG" in errors
