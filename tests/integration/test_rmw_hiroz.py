"""`macs rmw-zenoh` with robots made of the Rust crate hiroz: topics and services both ways, an action."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import NamedTuple

import pytest

from bridge.headset.client import Headset
from bridge.headset.nodes import ServiceRequest
from macs_zenoh.protocol.rmw_zenoh.cdr import read_text, written_text
from macs_zenoh.typed import Types
from tests.support.hiroz import Example, program
from tests.support.programs import Program, macs
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = [pytest.mark.timeout(300), pytest.mark.soak]

DOMAIN = 32
CDR = b"\0\1\0\0"
STRING = "std_msgs/msg/String"
ACTION = "action_tutorials_interfaces/action/Fibonacci"
DEFINED = {
    "action_tutorials_interfaces/action/Fibonacci.action": (
        "int32 order\n---\nint32[] sequence\n---\nint32[] partial_sequence\n"
    ),
    "example_interfaces/srv/AddTwoInts.srv": "int64 a\nint64 b\n---\nint64 sum\n",
}


class Site(NamedTuple):
    """A router, `macs rmw-zenoh` and a gateway on it, and a headset."""

    endpoint: str
    headset: Headset
    definitions: Path

    async def there(self, there: bool = True) -> None:
        """Wait until robot 7 is online, or is not."""

        async def is_there() -> bool:
            return (7 in (await self.headset.online()).ros_agent_ids) is there

        await until(is_there, PATIENCE_S)


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    program("talker")  # that they are here
    folder = tmp_path / "own"
    for name, text in DEFINED.items():
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text(text, encoding="utf-8")
    settings = tmp_path / "robots.toml"
    robot = f'[rmw_zenoh]\ndefinitions = ["{folder}"]\n[[rmw_zenoh.robots]]\nid = 7\ndomain = {DOMAIN}\n'
    settings.write_text(robot, encoding="utf-8")
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        router = await enter(Router())
        await enter(Program("rmw-zenoh", "--settings", str(settings), "-e", router.endpoint))
        gateway = await enter(Program("gateway", "--port", "0", "-e", router.endpoint))
        yield Site(router.endpoint, await enter(await Headset.connect("127.0.0.1", gateway.port)), folder)


async def test_topics_both_ways(site: Site) -> None:
    """A headset hears its talker, its listener hears a headset; killed, it is gone, and back it is heard again."""
    talker = Example("talker", "-p", "0.05", "-e", site.endpoint, domain=DOMAIN)
    async with talker:
        began = time.monotonic()
        await site.there()
        print(f"online {time.monotonic() - began:.3f} s after it had said that it publishes")

        async def offered() -> bool:
            shown = [one for one in await macs("ls", "-v", "--json", "-e", site.endpoint) if one["type"] == "ros"]
            return [(one["offers"] or {}).get("publishers", {}).get("/chatter") for one in shown] == [STRING]

        await until(offered, PATIENCE_S)
        heard = await site.headset.subscribe("/chatter", "std_msgs/String", agents=[7])
        texts = [read_text(bytes((await anext(heard)).data)).decode() for _ in range(5)]
        first = int(texts[0].rpartition(" ")[2])
        assert texts == [f"Hello World: {first + number}" for number in range(5)]
        await talker.stop(9)
        await site.there(False)
        await talker.start()
        await site.there()

        async def again() -> bool:
            return read_text(bytes((await anext(heard)).data)).startswith(b"Hello World: ")

        assert await asyncio.wait_for(again(), PATIENCE_S)

    listener = Example("listener", "-t", "orders", "-e", site.endpoint, ready="go", domain=DOMAIN)
    starting = asyncio.create_task(listener.start())  # it says nothing before it hears something
    try:
        await site.there()
        orders = await site.headset.advertise("/orders", "std_msgs/String", agents=[7])

        async def obeyed() -> bool:
            await orders.publish(written_text(b"go"))
            return listener.says("I heard: [go]")

        await until(obeyed, PATIENCE_S, every_s=0.05)
        await starting
    finally:
        starting.cancel()
        await listener.stop(9)


async def test_services_both_ways(site: Site) -> None:
    """A headset calls its service; its client calls one of a headset's."""
    server = Example("add_two_ints_server", "-e", site.endpoint, ready="started", domain=DOMAIN)
    async with server:
        await site.there()

        def request(one: int, other: int) -> bytes:
            return CDR + one.to_bytes(8, "little") + other.to_bytes(8, "little")

        for one, other in ((2, 3), (40, 2)):
            answer = await site.headset.call(
                "/add_two_ints", "example_interfaces/AddTwoInts", 7, request(one, other), timeout_s=PATIENCE_S
            )
            assert int.from_bytes(answer[4:12], "little") == one + other
        assert server.says(f"a: {40} b: {2}")

    async def multiply(asked: ServiceRequest) -> bytes:
        one, other = (int.from_bytes(asked.data[at : at + 8], "little") for at in (4, 12))
        return CDR + (one * other).to_bytes(8, "little")

    talker = Example("talker", "-e", site.endpoint, domain=DOMAIN)  # a robot is there while a node of it is
    async with talker:
        await site.there()
        await site.headset.serve("/add_two_ints", "example_interfaces/AddTwoInts", multiply, agents=[7])
        client = Example("add_two_ints_client", "-a", "6", "-b", "7", "-e", site.endpoint, domain=DOMAIN)
        async with client:
            await until(lambda: client.says("Received response: 42"), PATIENCE_S)
            assert await asyncio.wait_for(client.wait(), PATIENCE_S) == 0


async def test_an_action_from_a_headset(site: Site) -> None:
    """Accepted with feedback and a result; cancelled while it runs."""
    types = Types([site.definitions])
    async with Example("fibonacci_action_server", site.endpoint, ready="started", domain=DOMAIN):
        await site.there()
        action = await site.headset.action("/fibonacci", "action_tutorials_interfaces/Fibonacci", agents=[7])
        goal = await action.send_goal(7, CDR + (4).to_bytes(4, "little"), timeout_s=PATIENCE_S)
        result = await goal.result(PATIENCE_S)
        assert result.status == 4
        assert types.deserialize(f"{ACTION}_Result", result.data) == {"sequence": [0, 1, 1, 2, 3]}
        fed = [types.deserialize(f"{ACTION}_Feedback", each)["partial_sequence"] async for each in goal]
        assert fed[-1] == [0, 1, 1, 2, 3]
        long = await action.send_goal(7, CDR + (40).to_bytes(4, "little"), timeout_s=PATIENCE_S)
        assert await asyncio.wait_for(anext(aiter(long)), PATIENCE_S)
        await long.cancel(PATIENCE_S)
        ended = await long.result(PATIENCE_S)
        assert ended.status == 5
        assert len(types.deserialize(f"{ACTION}_Result", ended.data)["sequence"]) < 40
