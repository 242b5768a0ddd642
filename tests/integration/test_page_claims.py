"""What pages promise of a gateway, tried: sentences that were once untrue, or would be noticed late."""

from __future__ import annotations

import asyncio

import pytest

import macs_zenoh
from bridge.gateway.server import Gateway
from bridge.headset.client import Headset
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.waiting import PATIENCE_S


async def test_what_waits_beyond_its_limit_is_dropped_and_the_connection_stays(
    router: str, start_gateway: StartGateway, connect: Connect, caplog: pytest.LogCaptureFixture
) -> None:
    """docs/compatibility.md, docs/design.md: a headset behind by more than ``outbox_bytes`` loses the newest, is not
    disconnected, and goes on with what waited when it reads again."""
    gateway: Gateway = await start_gateway(outbox_bytes=1 << 20)
    headset: Headset = await connect(gateway)
    number = headset.id
    headset.pause()
    async with macs_zenoh.join("ros", id=1, settings=patient(router)) as robot:
        for sent in range(2000):
            robot.send(sent.to_bytes(4, "big") + bytes(50_000), to="unity", ids=[headset.id])
            await asyncio.sleep(0.002)
            if "counted as outbox_full" in caplog.text:
                break
        assert "counted as outbox_full" in caplog.text
        headset.resume()
        received = [int.from_bytes((await headset.receive(PATIENCE_S)).data[:4], "big") for _ in range(5)]
    assert received == list(range(5))  # those that waited, in order
    assert number in (await headset.online()).unity_agent_ids
    assert headset.id == number
