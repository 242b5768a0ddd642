"""Real routers, real gateways, real sockets on 127.0.0.1; in this process where a test does not kill them."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

from bridge.gateway import Gateway
from bridge.headset.client import Headset
from bridge.settings import GatewaySettings
from macs_zenoh.config import TrafficRule
from macs_zenoh.mesh import Mesh
from macs_zenoh.sections import changed
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.routers import Router


@pytest.fixture
async def start_gateway(router: str) -> AsyncIterator[StartGateway]:
    """Starts gateways on the router; keyword arguments are their settings, and ``traffic`` rules."""
    async with AsyncExitStack() as stack:

        async def start(endpoint: str = router, traffic: Sequence[TrafficRule] = (), **settings: object) -> Gateway:
            opening = Mesh.open(patient(endpoint), traffic=traffic)
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


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[object]:
    """A site whose router runs."""
    from tests.support.secured import made  # most tests need no certificates

    found = made(tmp_path / "pki")
    async with Router(found.file()):
        yield found
