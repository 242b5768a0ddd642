"""Cores that wake fast while messages pass: what Linux has been asked for, as Linux tells it."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Iterator

import pytest

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import NotServed
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.mesh.cpu_latency import Awake
from tests.integration.conftest import until

STREAM_KEY = "macs/from/ros/7/nd__map"
KEY = "macs/to/ros/7/from/unity/256"
OURS_US = 137
"""Nobody else on this machine asks for just that."""


def asked_us() -> int:
    """What the strictest request on this machine is."""
    device = os.open(Awake.DEVICE, os.O_RDONLY)
    try:
        return int.from_bytes(os.read(device, 4), sys.byteorder)
    finally:
        os.close(device)


@pytest.fixture
def settings(router: str) -> MeshSettings:
    return MeshSettings(connect=[router], awake_us=OURS_US)


@pytest.fixture
def quiet_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Awake, "QUIET_S", 0.5)


@pytest.fixture
def permitted() -> Iterator[None]:
    """Only where this user may ask, and nobody asks for more."""
    if not os.access(Awake.DEVICE, os.W_OK):
        pytest.skip(f"this user may not write {Awake.DEVICE}")
    if asked_us() <= OURS_US:
        pytest.skip("another program on this machine keeps its cores awake")
    yield
    assert asked_us() > OURS_US


@pytest.mark.usefixtures("permitted", "quiet_soon")
async def test_cores_are_kept_awake_while_messages_are_sent(settings: MeshSettings) -> None:
    async with await Mesh.open(settings) as mesh:
        mesh.keep_awake()
        await asyncio.sleep(3 * Awake.LOOK_S)
        assert asked_us() > OURS_US, "nothing has passed yet"
        mesh.put(KEY, b"x")
        await until(lambda: asked_us() == OURS_US)
        await until(lambda: asked_us() > OURS_US)
        mesh.put(KEY, b"x")
        await until(lambda: asked_us() == OURS_US)


@pytest.mark.usefixtures("permitted")
async def test_cores_are_kept_awake_while_messages_come(router: str, settings: MeshSettings) -> None:
    async with await Mesh.open(MeshSettings(connect=[router])) as sender, await Mesh.open(settings) as mesh:
        mesh.keep_awake()
        mesh.subscribe(KEY, lambda _batch: None)
        await until(lambda: sender.put(KEY, b"x") or asked_us() == OURS_US)


@pytest.mark.usefixtures("permitted", "quiet_soon")
async def test_cores_are_kept_awake_while_questions_pass(router: str, settings: MeshSettings) -> None:
    async with await Mesh.open(MeshSettings(connect=[router])) as other, await Mesh.open(settings) as mesh:
        mesh.keep_awake()
        with pytest.raises(NotServed):
            await mesh.query("macs/nobody", b"", timeout_s=2)
        await until(lambda: asked_us() == OURS_US)
        await until(lambda: asked_us() > OURS_US)

        async def answer(_key: str, _payload: bytes) -> bytes:
            return b"here"

        serving = mesh.serve("macs/somebody", answer)
        while True:  # until the router knows of it
            try:
                assert await other.query("macs/somebody", b"", timeout_s=2) == b"here"
                break
            except NotServed:
                await asyncio.sleep(0.02)
        await until(lambda: asked_us() == OURS_US)
        serving.close()


@pytest.mark.usefixtures("permitted", "quiet_soon")
async def test_heartbeats_of_a_quiet_source_let_cores_sleep(router: str, settings: MeshSettings) -> None:
    got: list[bytes] = []
    async with await Mesh.open(MeshSettings(connect=[router])) as source, await Mesh.open(settings) as mesh:
        mesh.keep_awake()
        mesh.subscribe(STREAM_KEY, lambda batch: got.extend(bytes(payload) for _, payload in batch), reliable=True)
        source.keep(STREAM_KEY, 10)
        await until(lambda: source.put(STREAM_KEY, b"x", Traffic.STREAM) or (got and asked_us() == OURS_US))
        await until(lambda: asked_us() > OURS_US)
        for _ in range(20):  # over several heartbeats
            await asyncio.sleep(0.1)
            assert asked_us() > OURS_US


@pytest.mark.usefixtures("permitted")
async def test_who_only_looks_asks_for_nothing(settings: MeshSettings) -> None:
    async with await Mesh.open(settings) as mesh:
        mesh.put(KEY, b"x")
        await asyncio.sleep(3 * Awake.LOOK_S)
        assert asked_us() > OURS_US


@pytest.mark.usefixtures("permitted")
async def test_a_program_that_leaves_asks_for_nothing_any_more(settings: MeshSettings) -> None:
    mesh = await Mesh.open(settings)
    mesh.keep_awake()
    mesh.put(KEY, b"x")
    await until(lambda: asked_us() == OURS_US)
    await mesh.close()
    assert asked_us() > OURS_US
    await asyncio.sleep(2 * Awake.LOOK_S)
    assert asked_us() > OURS_US


async def test_who_may_not_ask_hears_so_once_and_goes_on(
    router: str, settings: MeshSettings, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Awake, "DEVICE", "/nonexistent/cpu_dma_latency")
    got: list[str] = []
    with caplog.at_level(logging.WARNING, "macs.mesh"):
        async with await Mesh.open(MeshSettings(connect=[router])) as receiver, await Mesh.open(settings) as mesh:
            mesh.keep_awake()
            receiver.subscribe(KEY, lambda batch: got.extend(key for key, _ in batch))
            await until(lambda: mesh.put(KEY, b"x") or bool(got))
            await asyncio.sleep(3 * Awake.LOOK_S)
    [said] = [record.message for record in caplog.records if "awake_us" in record.message]
    assert said.startswith("awake_us has no effect: /nonexistent/cpu_dma_latency: No such file or directory (docs/")
