"""Our programs with the files that are generated from a policy, on real routers."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

import macs_zenoh
from bridge.gateway import Gateway
from bridge.headset.client import Headset
from bridge.security import policy
from bridge.settings import load
from macs_zenoh import awareness, config
from macs_zenoh.errors import Unreachable
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.messages import Metadata, NodeType, StreamData, encode_management
from macs_zenoh.protocol.named import Outcome
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.sections import changed
from macs_zenoh.streams import Streams
from tests.support.numbers import Numbers, Stream
from tests.support.programs import ROOT, Program, ended, macs
from tests.support.routers import Router
from tests.support.secured import CLIENTS, Site, made
from tests.support.waiting import PATIENCE_S, until


async def test_our_programs_work_with_the_generated_files(site: Site) -> None:
    """A gateway process, a headset on it and robots, each with its own file: topics, commands and names."""

    @asynccontextmanager
    async def robot_of(name: str, number: int, group: int) -> AsyncIterator[macs_zenoh.Agent]:
        async with macs_zenoh.join("ros", id=number, group=group, settings=site.settings(name)) as agent:

            async def add(call: macs_zenoh.Call) -> bytes:
                return b""

            agent.serve("add_node", add)
            yield agent

    async with (
        Program("gateway", "--settings", str(site.directory / "hall-1" / "macs.toml"), "--port", "0") as gateway,
        robot_of("robot-7", 7, 3) as robot,
        robot_of("robot-8", 8, 3) as other,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
        awareness.join(robot, "drone7") as drone,
        awareness.join(other, "drone8") as second,
    ):
        assert headset.id // 256 == 1
        while {7, 8} - set((await headset.online()).ros_agent_ids):
            await asyncio.sleep(0.02)
        await headset.send(b"command", to=1, ids=[7])
        await headset.send(b"to the group", to=1, groups=[3])
        assert [(await asyncio.wait_for(robot.receive(), PATIENCE_S)).data for _ in range(2)] == [
            b"command",
            b"to the group",
        ]
        assert (await asyncio.wait_for(other.receive(), PATIENCE_S)).data == b"to the group"

        topic = await headset.subscribe("/pose", "std_msgs/String", agents=[7])
        metadata = Metadata(1, 7, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__pose", "std_msgs/String")
        management = encode_management(StreamData({"2": [headset.id]}))
        frame = encode_frame(1, management=management, message=encode_message(metadata.encode(), b"topic data"))
        while True:
            Streams(robot).publish("nd__pose", frame)  # until it knows of the subscription
            with suppress(asyncio.TimeoutError):
                message = await asyncio.wait_for(topic.__anext__(), 0.1)
                break
        assert bytes(message.data) == b"topic data"

        received: asyncio.Queue[awareness.Received] = asyncio.Queue()
        second.register("planning", received.put_nowait)
        await drone.wait_for("drone8", "planning", timeout_s=PATIENCE_S)
        assert await drone.deliver("drone8", "planning", b"by name", deadline_s=PATIENCE_S) is Outcome.DELIVERED
        assert (await asyncio.wait_for(received.get(), PATIENCE_S)).data == b"by name"


async def test_what_was_missed_is_asked_for(tmp_path: Path) -> None:
    """A gateway gets what it missed of a reliable topic, and a robot of a reliable message type, through a restart of
    the router."""
    found = made(tmp_path / "pki")
    rules = [config.TrafficRule(match="**", cache=5000)]
    keys = ("macs/from/ros/7/nd__log", "macs/ca/all/planning/by/drone7")
    router = Router(found.file())
    async with (
        router,
        await Mesh.open(found.settings("robot-7"), traffic=rules) as source,
        await Mesh.open(found.settings("hall-1")) as hall,
        await Mesh.open(found.settings("robot-8")) as robot,
        Stream(source, *keys) as stream,
    ):
        topic, messages = Numbers(), Numbers()
        hall.subscribe(keys[0], topic.take, reliable=True, on_miss=topic.miss)
        robot.subscribe("macs/ca/all/planning/by/**", messages.take, reliable=True, on_miss=messages.miss)
        await until(lambda: topic.heard and messages.heard)
        await router.stop(signal.SIGKILL)
        before = stream.sent
        await until(lambda: stream.sent > before + 20)
        await router.start()
        back = stream.sent
        for got in (topic, messages):
            await until(lambda got=got: got.heard[-1] >= back)  # type: ignore[misc]
            assert got.heard == list(range(got.heard[0], got.heard[-1] + 1))
            assert not got.missed


async def test_an_operator_looks(site: Site) -> None:
    """`macs ls` with an operator's settings sees everybody."""
    async with (
        macs_zenoh.join("ros", id=9, settings=site.settings("robot-9")),
        macs_zenoh.join("unity", id=256, settings=site.settings("hall-1")),
    ):
        rows = await macs("ls", "--json", "--settings", str(site.directory / "anna" / "macs.toml"))
        assert {(row["type"], row["id"]) for row in rows} == {("ros", 9), ("unity", 256)}


async def test_an_operator_stops_with_its_own_file(tmp_path: Path) -> None:
    """The generated settings say who an operator is, so that it stops robots and asks them without --as; who asks as
    somebody else is told that rules may be why nobody answers."""
    clients = CLIENTS.replace("{name: anna}", "{name: anna, id: 5}")
    site = made(tmp_path / "pki", clients.replace("may: call, verbs: [status]", "may: [command, call]"))
    settings = ("--settings", str(site.directory / "anna" / "macs.toml"))
    callers: list[str] = []

    async def answer(call: macs_zenoh.Call) -> bytes:
        callers.append(f"{call.verb} by {call.sender_type}/{call.sender_id}")
        return b'{"ros_node": "/r", "stopped": true, "stop": {"by": "operator/5"}, "nodes": []}'

    async with (
        Router(site.file()),
        macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")) as robot,
    ):
        for verb in ("status", "stop"):
            robot.serve(verb, answer)
        while not (await macs("ls", "--json", *settings))[0]["status"]:  # until the router knows what it serves
            await asyncio.sleep(0.02)
        assert set(callers) == {"status by operator/5"}
        code, out, _ = await ended("stop", *settings)
        assert (code, out) == (0, "robot 7 is stopped, by operator/5\n")
        code, out, _ = await ended("doctor", "--quick", *settings)
        assert (code, "operator/5" in out) == (0, True), out

        denied = "it does not answer operator/0; access rules may not allow it (--as operator/N)"
        nobody = (*settings, "--as", "operator/0")
        code, out, _ = await ended("stop", "--timeout", "1", *nobody)
        assert (code, out) == (1, f"robot 7 is NOT stopped: {denied}\n")
        assert (await macs("ls", "--json", *nobody))[0]["problem"] == denied
        code, out, _ = await ended("ls", *nobody)
        assert out.splitlines()[1].endswith("?")
        code, out, _ = await ended("ls", "-v", *nobody)
        assert f"tells nothing: {denied}" in out


@pytest.mark.parametrize("verbs", ["status", "status, ping"])
async def test_an_operator_who_may_not_stop_hears_which_right_is_missing(tmp_path: Path, verbs: str) -> None:
    """A robot that tells its state has an emergency stop; that this operator may not use it is said."""
    site = made(tmp_path / "pki", CLIENTS.replace("[status]", f"[{verbs}]"))

    async def answer(call: macs_zenoh.Call) -> bytes:
        return b'{"ros_node": "/r", "stopped": true, "stop": {"by": "operator/0"}, "nodes": []}'

    async with (
        Router(site.file()),
        macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")) as robot,
    ):
        for verb in ("status", "stop"):
            robot.serve(verb, answer)
        settings = ("--settings", str(site.directory / "anna" / "macs.toml"))
        while not (await macs("ls", "--json", *settings))[0]["status"]:
            await asyncio.sleep(0.02)
        code, out, _ = await ended("stop", "--timeout", "3", *settings)
        assert (code, out.partition(";")[0]) == (
            1,
            "robot 7 is NOT stopped: access rules do not let operator/0 call its verb stop",
        )
        assert "a policy gives it by `may: call` with `verbs: [stop]`" in out


def test_the_shipped_wan_plan_has_an_operator_who_may_stop() -> None:
    """Somebody who looks at robots from wherever can stop them, and can do no more to them."""
    wan = policy.load(ROOT / "config" / "wan" / "policy.yaml")
    (anna,) = wan.operators
    for robot in wan.robots:
        verbs = wan.verbs(anna, robot)
        assert verbs is not None
        assert {"status", "stop"} <= set(verbs)
        assert not wan.may(anna, "command", robot)


@pytest.mark.parametrize(
    ("file", "content", "problem"),
    [
        ("ca.pem", None, "No such file or directory"),
        ("key.pem", b"garbage", "there is no private key in this file"),
        ("cert.pem", b"", "there is no certificate in this file"),
    ],
)
async def test_a_file_that_cannot_be_used_is_named(
    file: str, content: bytes | None, problem: str, tmp_path: Path
) -> None:
    """Programs end at once, and name the setting and the file."""
    site = made(tmp_path / "pki")
    for name in ("hall-1", "site"):
        path = site.directory / name / file
        path.unlink()
        if content is not None:
            path.write_bytes(content)
    settings = ("--settings", str(site.directory / "hall-1" / "macs.toml"))
    for verb in ("gateway", "ls"):
        code, _, errors = await ended(verb, *settings)
        assert code == 2, errors
        assert f"{site.directory / 'hall-1' / file}: {problem}" in errors
        assert "transport/link/tls/" in errors
    code, _, errors = await ended("router", "-c", str(site.file()))
    assert code == 2, errors
    assert f"{path}: {problem}" in errors


async def test_a_gateway_keeps_to_its_blocks(site: Site) -> None:
    """A second gateway with the same certificate finds no block that it may have."""
    settings = str(site.directory / "hall-1" / "macs.toml")
    async with Program("gateway", "--settings", settings, "--port", "0"):
        loaded = load(settings)
        async with await Mesh.open_once(loaded.mesh, timeout_s=10) as mesh:
            second = Gateway(mesh, changed(loaded.gateway, port=0))
            try:
                with pytest.raises(Unreachable, match="all that this gateway may have"):
                    await second.start()
            finally:
                await second.close()
