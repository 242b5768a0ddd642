"""Router, gateway and robot agent are killed one at a time, with ten headsets on a 100 Hz topic."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field

import pytest
from std_msgs.msg import String

from bridge.headset.client import Headset
from tests.support.programs import Program, free_port
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S

BACK_S = PATIENCE_S
"""How long the stream may take to be back before the test gives up; it takes well under a second, see the output."""
DEPTH = 2000
"""Nobody loses a message by standing still for a while on a busy machine."""


@dataclass
class Listener:
    """A headset on the topic, and the numbers it has heard with their times."""

    gateway: int
    headset: Headset
    heard: list[tuple[int, float]] = field(default_factory=list)

    async def listen(self) -> None:
        topic = await self.headset.subscribe("/count", "std_msgs/String", agents=[1], buffer_size=DEPTH)
        async for message in topic:
            self.heard.append((int(message.data[8:].rstrip(b"\0")), time.monotonic()))

    def since(self, moment: float) -> list[int]:
        return [number for number, at in self.heard if at > moment]


@dataclass
class Fleet:
    """Everything that runs."""

    programs: dict[str, Program]
    listeners: list[Listener]

    async def restart(self, name: str) -> float:
        """Kill -9 a program and start it again; when it was ready."""
        program = self.programs[name]
        program.send_signal(signal.SIGKILL)
        with suppress(AssertionError):
            await program.stop()
        await program.start()
        return time.monotonic()

    async def all_hear(self, listeners: list[Listener], since: float, within_s: float) -> None:
        """Every listener hears the topic again."""
        deadline = since + within_s
        while silent := [listener for listener in listeners if not listener.since(since)]:
            assert time.monotonic() < deadline, f"{len(silent)} of {len(listeners)} hear nothing"
            await asyncio.sleep(0.02)


@pytest.fixture
async def fleet(domain: int, peer: Peer) -> AsyncIterator[Fleet]:
    """A router, two gateways, a robot agent, and five headsets on each gateway."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    ports = [free_port(), free_port()]
    programs = {
        "router": Program("router", "-l", endpoint),
        "first gateway": Program("gateway", "--port", str(ports[0]), "-e", endpoint),
        "second gateway": Program("gateway", "--port", str(ports[1]), "-e", endpoint),
        "robot": Program("agent", "--id", "1", "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)}),
    }
    async with AsyncExitStack() as stack:
        for program in programs.values():
            await stack.enter_async_context(program)
        listeners = []
        for number in range(10):
            headset = await Headset.connect("127.0.0.1", ports[number % 2], reconnect=True)
            listeners.append(Listener(number % 2, await stack.enter_async_context(headset)))
        publisher = await peer.publisher(String, "/count", DEPTH)
        tasks = [asyncio.create_task(listener.listen()) for listener in listeners]
        tasks.append(asyncio.create_task(_count(publisher)))
        fleet = Fleet(programs, listeners)
        await fleet.all_hear(listeners, 0.0, time.monotonic() + PATIENCE_S)
        try:
            yield fleet
        finally:
            for task in tasks:
                task.cancel()


async def _count(publisher: object) -> None:
    number = 0
    while True:
        number += 1
        publisher.publish(String(data=str(number)))  # type: ignore[attr-defined]
        await asyncio.sleep(0.01)


@pytest.mark.parametrize("name", ["router", "second gateway", "robot"])
async def test_the_stream_comes_back_by_itself(name: str, fleet: Fleet) -> None:
    """The stream is back soon after the program's return, with nothing restarted by hand, and no headset of a
    gateway that survived hears anything twice or out of order."""
    killed = time.monotonic()
    ready = await fleet.restart(name)
    survivors = [listener for listener in fleet.listeners if name != "second gateway" or listener.gateway == 0]
    await fleet.all_hear(survivors, ready, BACK_S)
    print(f"after the {name}'s return: {time.monotonic() - ready:.2f} s")
    await fleet.all_hear(fleet.listeners, ready, BACK_S)
    await asyncio.sleep(0.3)  # what would come twice would come by now
    for listener in survivors:
        numbers = [number for number, _ in listener.heard]
        assert numbers == sorted(set(numbers)), "something came twice or out of order"
        if name == "second gateway":
            assert numbers == list(range(numbers[0], numbers[-1] + 1)), "a neighbour's gateway cost messages"
    assert all(listener.headset.connected for listener in survivors)
    assert killed < ready
