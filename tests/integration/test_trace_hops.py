"""What takes long at a hop is shown at that hop: commands on every link of their way, and a real gateway both ways."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import pytest

from bridge.gateway import Gateway
from bridge.gateway.forwarding import Forwarding
from bridge.gateway.writer import Writer
from bridge.headset.client import Headset
from tests.integration.test_trace import INJECTED_S, robot
from tests.support.given import Connect, StartGateway
from tests.support.links import delayed
from tests.support.programs import Program, ended
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S

COUNT = 100
COMMAND = b"\x00\x01\x00\x00\x02\x00\x00\x00x\x00"


@asynccontextmanager
async def driving(headset: Headset) -> AsyncIterator[None]:
    """Commands, thirty a second."""
    publisher = await headset.advertise("/cmd", "std_msgs/String", agents=[7])

    async def drive() -> None:
        while True:
            await publisher.publish(COMMAND, agents=[7])
            await asyncio.sleep(0.03)

    task = asyncio.create_task(drive())
    try:
        yield
    finally:
        task.cancel()


async def traced(endpoint: str, *words: str) -> list[dict[str, Any]]:
    """Each way that `macs trace` tells of."""
    count = ("--count", str(COUNT), "--seconds", "90", "--json")
    code, out, log = await ended("trace", *words, "--robot", "7", *count, "-e", endpoint)
    assert code == 0, log
    return [json.loads(line) for line in out.splitlines()]


def slow(way: dict[str, Any]) -> list[str]:
    """The hops that took so long for each message; the whole is the sum of all."""
    assert way["count"] >= COUNT
    total = sum(hop["mean_ms"] for hop in way["hops"])
    assert total == pytest.approx(way["end_to_end"]["mean_ms"], rel=0.05, abs=0.1)
    return [hop["hop"] for hop in way["hops"] if hop["min_ms"] >= 1000 * INJECTED_S]


@pytest.mark.parametrize("where", ["to the router", "between the routers", "to the robot"])
async def test_a_slow_link_of_commands_is_shown(where: str) -> None:
    """Of a hundred commands each, through two routers in a row."""
    async with AsyncExitStack() as stack:

        async def reached(endpoint: str, name: str) -> str:
            return await stack.enter_async_context(delayed(endpoint, INJECTED_S)) if where == name else endpoint

        first = await stack.enter_async_context(Router())
        second = await stack.enter_async_context(
            Router(connect=[await reached(first.endpoint, "between the routers")])
        )
        await stack.enter_async_context(robot(await reached(first.endpoint, "to the robot")))
        words = ("gateway", "--port", "0", "-e", await reached(second.endpoint, "to the router"))
        gateway = await stack.enter_async_context(Program(*words))
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        async with driving(headset):
            (way,) = await traced(second.endpoint, "/cmd", "--commands")
        names = [hop["hop"] for hop in way["hops"]]
        places = {
            "to the router": next(name for name in names if name.startswith("gateway") and " to router" in name),
            "between the routers": next(name for name in names if name.startswith("router") and " to router" in name),
            "to the robot": next(name for name in names if name.endswith(" to robot 7")),
        }
        assert slow(way) == [places[where]]


async def test_a_slow_socket_is_shown(
    router: str, start_gateway: StartGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the gateway takes to write to its headsets is at that hop, and at no other."""
    gateway: Gateway = await start_gateway()
    headset = await connect(gateway)

    def late(write: Callable[..., Any]) -> Callable[..., Any]:
        def written(self: Writer, *args: Any, **options: Any) -> Any:
            time.sleep(INJECTED_S)
            return write(self, *args, **options)

        return written

    async with robot(router):
        subscription = await headset.subscribe("/chatter", "std_msgs/String", agents=[7])
        await asyncio.wait_for(anext(subscription), PATIENCE_S)
        for name in ("write_now", "gather"):  # at once, and by the loop
            monkeypatch.setattr(Writer, name, late(getattr(Writer, name)))
        ways = await traced(router, "/chatter", "--every", "3")
    (way,) = [way for way in ways if way["receiver"].startswith("gateway")]
    assert slow(way)[-1] == way["hops"][-1]["hop"] == f"{way['receiver']}: handled"


async def test_a_slow_gateway_is_shown(
    router: str, start_gateway: StartGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it takes from a headset's socket to the mesh, likewise."""
    gateway: Gateway = await start_gateway()
    headset = await connect(gateway)
    forward = Forwarding.forward

    def late(self: Forwarding, *args: Any) -> None:
        time.sleep(INJECTED_S)
        forward(self, *args)

    async with robot(router), driving(headset):
        monkeypatch.setattr(Forwarding, "forward", late)
        (way,) = await traced(router, "/cmd", "--commands")
    assert slow(way) == [way["hops"][0]["hop"]]
    assert way["hops"][0]["hop"].endswith(": gateway")
