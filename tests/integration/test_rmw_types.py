"""Robots that run rmw_zenoh with types of their own, and with actions."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import macs_zenoh
from bridge.headset.client import Headset
from macs_zenoh import ros
from macs_zenoh.mesh.ros_network import Request
from macs_zenoh.protocol.rmw_zenoh.qos import Qos
from macs_zenoh.type_hashes import Hashes
from macs_zenoh.typed import Types
from tests.support.programs import Program
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)

THING = "string name\nfloat64[] weights\n"
FIBONACCI = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"
ACTION = "example_interfaces/action/Fibonacci"
RULES = '\n[[robot.rules]]\nmatch = "/things"\ndeadman_s = 0.3\ndeadman_message = {name = "none"}\n'
CDR = b"\0\1\0\0"


def defined(folder: Path, package: str, kind: str, name: str, text: str) -> Path:
    path = folder / package / kind / f"{name}.{kind}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return folder


@asynccontextmanager
async def site(tmp_path: Path, settings: str) -> AsyncIterator[tuple[str, AsyncExitStack]]:
    """A router and `macs rmw-zenoh` with these settings."""
    file = tmp_path / "robots.toml"
    file.write_text(f"[[rmw_zenoh.robots]]\nid = 7\n{settings}", encoding="utf-8")
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Router())
        await stack.enter_async_context(Program("rmw-zenoh", "--settings", str(file), "-e", router.endpoint))
        yield router.endpoint, stack


async def test_a_type_that_only_the_robot_knows(tmp_path: Path) -> None:
    """The program asks the robot's node what its type consists of, and can make the dead-man's message of it."""
    folder = defined(tmp_path / "own", "demo_msgs", "msg", "Thing", THING)
    fields = [("name", 17), ("weights", 11 + 144)]
    described = {
        "type_name": "demo_msgs/msg/Thing",
        "fields": [
            {"name": name, "type": {"type_id": number, "capacity": 0, "string_capacity": 0, "nested_type_name": ""}}
            for name, number in fields
        ],
    }
    asked: list[dict[str, Any]] = []

    async def describe(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request)
        return {"successful": True, "type_description": {"type_description": described}}

    async with site(tmp_path, RULES) as (endpoint, stack):
        node = await stack.enter_async_context(ros.node("shop", connect=[endpoint], definitions=[folder]))
        node.serve("~/get_type_description", "type_description_interfaces/GetTypeDescription", describe)
        things = node.subscribe("/things", "demo_msgs/Thing")
        got: list[dict[str, Any]] = []

        async def listen() -> None:
            async for message in things:
                got.append(message.value)

        listening = asyncio.create_task(listen())
        stack.callback(listening.cancel)
        agent = await stack.enter_async_context(macs_zenoh.join("unity", id=300, connect=[endpoint]))
        await until(lambda: agent.directory.ids(1) == [7], PATIENCE_S)
        drive = await agent.advertise("/things", robot=7)
        one = node.types.serialize("demo_msgs/Thing", {"name": "nut", "weights": [1.5]})

        def comes() -> bool:
            drive.publish(one)
            return {"name": "nut", "weights": [1.5]} in got

        await until(comes, PATIENCE_S, every_s=0.05)
        await until(lambda: got[-1] == {"name": "none", "weights": []}, PATIENCE_S)
        assert [each["type_name"] for each in asked] == ["demo_msgs/msg/Thing"]
        assert asked[0]["type_hash"] == Hashes(Types([folder])).of("demo_msgs/msg/Thing")
        told = await agent.call("ros", 7, "definitions", b"")
        assert b"demo_msgs/msg/Thing" in told


class Counting:
    """An action server out of its parts: it adds a number to a sequence each 20 ms, and can be cancelled."""

    def __init__(self, node: ros.Node) -> None:
        self._node = node
        self._loop = asyncio.get_running_loop()
        hashes, made = Hashes(node.types), node._ros
        part = "/fibonacci/_action"
        self.parts = {
            name: made.service(f"{part}/{name}", of_type, hashes.of(of_type), self._on_loop(handler))
            for name, of_type, handler in (
                ("send_goal", f"{ACTION}_SendGoal", self._send),
                ("get_result", f"{ACTION}_GetResult", self._result),
                ("cancel_goal", "action_msgs/srv/CancelGoal", self._cancel),
            )
        }
        fed = f"{ACTION}_FeedbackMessage"
        self.feedback = made.publisher(f"{part}/feedback", fed, hashes.of(fed), Qos(depth=10))
        self._running: dict[bytes, asyncio.Task[None]] = {}
        self._results: dict[bytes, asyncio.Future[tuple[int, list[int]]]] = {}

    def _on_loop(self, handler: Any) -> Any:
        return lambda request: self._loop.call_soon_threadsafe(handler, request) and None

    def _send(self, request: Request) -> None:
        goal, order = request.cdr[4:20], int.from_bytes(request.cdr[20:24], "little")
        self.parts["send_goal"].answer(request, CDR + (b"\1" if order < 1000 else b"\0") + bytes(11))
        if order < 1000:
            self._results[goal] = self._loop.create_future()
            self._running[goal] = self._loop.create_task(self._count(goal, order))

    async def _count(self, goal: bytes, order: int) -> None:
        sequence: list[int] = []
        try:
            for number in range(order):
                sequence.append(number)
                cdr = self._node.types.serialize(f"{ACTION}_Feedback", {"sequence": sequence})
                self.feedback.publish(CDR + goal + cdr[4:])
                await asyncio.sleep(0.02)
            self._results[goal].set_result((4, sequence))
        except asyncio.CancelledError:
            self._results[goal].set_result((5, sequence))

    def _result(self, request: Request) -> None:
        def answer(done: asyncio.Future[tuple[int, list[int]]]) -> None:
            status, sequence = done.result()
            cdr = self._node.types.serialize(f"{ACTION}_Result", {"sequence": sequence})
            self.parts["get_result"].answer(request, CDR + bytes([status]) + b"\x7f\0\0" + cdr[4:])

        self._results[request.cdr[4:20]].add_done_callback(answer)

    def _cancel(self, request: Request) -> None:
        self._running[goal := request.cdr[4:20]].cancel()
        self.parts["cancel_goal"].answer(request, CDR + b"\0\x7f\0\0" + b"\1\0\0\0" + goal + bytes(8))


async def test_an_action_from_a_headset(tmp_path: Path) -> None:
    """Accepted with feedback and a result; cancelled; rejected: as with any other robot."""
    folder = defined(tmp_path / "own", "example_interfaces", "action", "Fibonacci", FIBONACCI)
    settings = f'\n[rmw_zenoh]\ndefinitions = ["{folder}"]\n'
    file = tmp_path / "robots.toml"
    file.write_text(f"{settings}[[rmw_zenoh.robots]]\nid = 7\n", encoding="utf-8")
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        router = await enter(Router())
        await enter(Program("rmw-zenoh", "--settings", str(file), "-e", router.endpoint))
        gateway = await enter(Program("gateway", "--port", "0", "-e", router.endpoint))
        node = await enter(ros.node("fib", connect=[router.endpoint], definitions=[folder]))
        counting = Counting(node)
        headset = await enter(await Headset.connect("127.0.0.1", gateway.port))

        async def there() -> bool:
            return 7 in (await headset.online()).ros_agent_ids

        await until(there, PATIENCE_S)
        action = await headset.action("/fibonacci", "example_interfaces/Fibonacci", agents=[7])
        goal = await action.send_goal(7, CDR + (5).to_bytes(4, "little"), timeout_s=PATIENCE_S)
        result = await goal.result(PATIENCE_S)
        types = node.types
        assert result.status == 4
        assert types.deserialize(f"{ACTION}_Result", result.data) == {"sequence": [0, 1, 2, 3, 4]}
        fed = [types.deserialize(f"{ACTION}_Feedback", each)["sequence"] async for each in goal]
        assert fed
        assert fed[-1] == [0, 1, 2, 3, 4][: len(fed[-1])]
        long = await action.send_goal(7, CDR + (900).to_bytes(4, "little"), timeout_s=PATIENCE_S)
        await long.cancel(PATIENCE_S)
        assert (await long.result(PATIENCE_S)).status == 5
        with pytest.raises(macs_zenoh.Refused, match="rejected"):
            await action.send_goal(7, CDR + (2000).to_bytes(4, "little"), timeout_s=PATIENCE_S)
        counting.feedback.close()
