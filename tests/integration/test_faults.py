"""Programs that die: what is lost, what comes back by itself, and what nobody notices."""

from __future__ import annotations

import asyncio
import signal
import time
from contextlib import AsyncExitStack, suppress

import pytest

import macs_zenoh
from bridge.headset.client import Headset
from macs_zenoh.protocol.messages import Metadata, NodeType, StreamData, encode_management
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams
from tests.support.delays import Delays
from tests.support.programs import Program, free_port
from tests.support.waiting import PATIENCE_S, until


def chatter(registrants: list[int], text: bytes) -> bytes:
    """A frame of robot 1's topic /chatter."""
    metadata = Metadata(1, 1, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__chatter", "std_msgs/String")
    management = encode_management(StreamData({"2": registrants}))
    return encode_frame(1, management=management, message=encode_message(metadata.encode(), text))


async def accept(call: macs_zenoh.Call) -> bytes:
    """What a robot answers to a registration."""
    return b""


async def test_the_router_is_killed_and_comes_back() -> None:
    """Headsets' sockets survive the router's kill -9; presence, messages and streams are back with it."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with AsyncExitStack() as stack:
        router = Program("router", "-l", endpoint)
        await router.start()
        gateways = [await stack.enter_async_context(Program("gateway", "--port", "0", "-e", endpoint)) for _ in "ab"]
        first, second = [
            await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port)) for gateway in gateways
        ]
        robot = await stack.enter_async_context(macs_zenoh.join("ros", id=1, connect=[endpoint]))
        robot.serve("add_node", accept)
        chatters = [await h.subscribe("/chatter", "std_msgs/String", agents=[1]) for h in (first, second)]

        async def works() -> None:
            """Messages between headsets and topic data to both arrive."""
            for source, target in ((first, second), (second, first)):
                got = asyncio.ensure_future(target.receive())
                while not got.done():
                    await source.send(b"x", to=2, ids=[target.id], manager="Greeting")
                    await asyncio.wait([got], timeout=0.05)
            for stream in chatters:
                arrived = asyncio.ensure_future(stream.__anext__())
                while not arrived.done():
                    Streams(robot).publish("nd__chatter", chatter([first.id, second.id], b"y"))
                    await asyncio.wait([arrived], timeout=0.05)

        await asyncio.wait_for(works(), PATIENCE_S)
        router.send_signal(signal.SIGKILL)
        with suppress(AssertionError):
            await router.stop()
        replacement = await stack.enter_async_context(Program("router", "-l", endpoint))
        await asyncio.wait_for(works(), PATIENCE_S)
        assert first.connected
        assert second.connected
        assert replacement.ready
        online = await first.online()
        assert (online.ros_agent_ids, online.unity_agent_ids) == ([1], sorted([first.id, second.id]))
        for gateway in gateways:
            await until(lambda gateway=gateway: sum(" lost; reconnecting" in line for line in gateway.log) == 1)


async def test_programs_start_without_a_router() -> None:
    """A gateway and an agent wait for their first router and say so once."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    waiting = asyncio.Event()
    gateway = Program("gateway", "--port", "0", "-e", endpoint)
    async with AsyncExitStack() as stack:
        starting = asyncio.ensure_future(gateway.start())
        stack.push_async_callback(gateway.stop)
        joining = macs_zenoh.join("unity", id=9, connect=[endpoint], on_waiting=lambda target: waiting.set())
        agent = asyncio.ensure_future(stack.enter_async_context(joining))
        await asyncio.wait_for(waiting.wait(), PATIENCE_S)
        while not any("waiting" in line for line in gateway.log):
            await asyncio.sleep(0.02)
        assert not starting.done()
        await stack.enter_async_context(Program("router", "-l", endpoint))
        await asyncio.wait_for(starting, PATIENCE_S)
        await asyncio.wait_for(agent, PATIENCE_S)
        await until(lambda: sum("waiting" in line for line in gateway.log) == 1)


@pytest.mark.alone
async def test_sigterm_is_a_clean_goodbye() -> None:
    """SIGTERM ends router, gateway and agent with exit code 0 within 2 s, and connected headsets get a FIN."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = Program("router", "-l", endpoint)
    await router.start()
    gateway = Program("gateway", "--port", "0", "-e", endpoint)
    await gateway.start()
    async with await Headset.connect("127.0.0.1", gateway.port) as headset:
        for program in (gateway, router):
            with Delays() as delays:
                begun = time.monotonic()
                assert await program.stop() == 0
                assert time.monotonic() - begun < 2 + delays.s()
        assert await asyncio.wait_for(headset.wait_ended(), PATIENCE_S)


async def test_two_signals_at_once_are_a_goodbye_too() -> None:
    """SIGTERM twice, as service managers and `timeout` send it, still closes the session: the process ends."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with Program("router", "-l", endpoint):
        for _ in range(3):
            gateway = Program("gateway", "--port", "0", "-e", endpoint)
            await gateway.start()
            gateway.send_signal(signal.SIGTERM)
            assert await gateway.stop() == 0


@pytest.mark.alone
async def test_a_waiting_gateway_stops_on_sigint() -> None:
    """Ctrl-C ends a gateway that still waits for its router, within 2 s."""
    gateway = Program("gateway", "--port", "0", "-e", f"tcp/127.0.0.1:{free_port()}")
    starting = asyncio.ensure_future(gateway.start())
    while not any("waiting" in line for line in gateway.log):
        await asyncio.sleep(0.02)
    with Delays() as delays:
        begun = time.monotonic()
        assert await gateway.stop(signal.SIGINT) == 0
        assert time.monotonic() - begun < 2 + delays.s()
    with suppress(AssertionError):
        await starting
