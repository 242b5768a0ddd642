"""A stop behind what the same headset sends to others, who stand still: how long it waits there."""

from __future__ import annotations

import asyncio
import time

import macs_zenoh
from benchmarks import sequence
from benchmarks.headset import Headset
from bridge.gateway.backpressure import HELD_S
from macs_zenoh.protocol.messages import UNITY
from tests.integration.test_presses import PRESS, Asked, can_be_asked, said
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.waiting import until

STILL = 12
SIZE, EACH = 64 << 10, 100
"""More than may wait for each, and what sockets hold."""


async def test_it_waits_for_all_who_stand_still_together(router: str, start_gateway: StartGateway) -> None:
    """A headset sends much to one after the other of twelve that read nothing, then presses a stop on the same socket:
    the robot has it much sooner than if the headset had been held a second for each of them."""
    gateway = await start_gateway(outbox_bytes=1 << 20)
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as robot:
        Asked(robot)
        heard: list[bytes] = []
        robot.on_message(lambda message: heard.append(message.data))
        still = [await asyncio.to_thread(Headset.join, gateway.port, 0) for _ in range(STILL)]
        sender = await asyncio.to_thread(Headset.join, gateway.port, 0)
        await can_be_asked(gateway, 7)
        await until(lambda: all((UNITY, each.id) in gateway.directory for each in (*still, sender)))
        load = b""
        for each in still:
            load += b"".join(sequence.messages(sender.id, SIZE, EACH, [{"ids": [each.id], "groups": []}]))
        load += said(PRESS, ids=(7,))
        began = time.monotonic()
        sending = asyncio.create_task(asyncio.to_thread(sender.socket.sendall, load))
        await until(lambda: heard, 3 * STILL * HELD_S)
        took_s = time.monotonic() - began
        await sending
        assert heard == [PRESS]
        assert sum(bool(each.all_drops()["outbox_full"]) for each in gateway.agents.online()) == STILL  # they stood
        assert took_s < STILL * HELD_S / 2
