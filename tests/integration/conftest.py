"""Real routers, real gateways, real sockets on 127.0.0.1; in this process where a test does not kill them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack

import pytest

from bridge.gateway import Gateway
from bridge.headset.client import Headset
from macs_zenoh.config import GatewaySettings, MeshSettings, TrafficRule, changed
from macs_zenoh.mesh import Mesh
from tests.programs import free_port

StartGateway = Callable[..., Awaitable[Gateway]]
Connect = Callable[..., Awaitable[Headset]]


@pytest.fixture
async def router() -> AsyncIterator[str]:
    """A Zenoh router; its endpoint."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with await Mesh.open(MeshSettings(mode="router", listen=[endpoint])):
        yield endpoint


@pytest.fixture
async def start_gateway(router: str) -> AsyncIterator[StartGateway]:
    """Starts gateways on the router; keyword arguments are their settings, and ``traffic`` rules."""
    async with AsyncExitStack() as stack:

        async def start(endpoint: str = router, traffic: Sequence[TrafficRule] = (), **settings: object) -> Gateway:
            opening = Mesh.open(MeshSettings(connect=[endpoint]), traffic=traffic)
            mesh = await stack.enter_async_context(await opening)
            gateway = Gateway(mesh, changed(GatewaySettings(port=0, robots="any"), **settings))
            stack.push_async_callback(gateway.close)
            await gateway.start()
            return gateway

        yield start


@pytest.fixture
async def connect() -> AsyncIterator[Connect]:
    """Connects headsets to a gateway."""
    async with AsyncExitStack() as stack:

        async def connect(gateway: Gateway, **options: object) -> Headset:
            headset = await Headset.connect("127.0.0.1", gateway.port, **options)  # type: ignore[arg-type]
            await stack.enter_async_context(headset)
            return headset

        yield connect


async def until(condition: Callable[[], object], timeout_s: float = 5.0) -> None:
    """Wait until the condition holds; fail when it does not."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "this did not happen in time"
        await asyncio.sleep(0.005)
