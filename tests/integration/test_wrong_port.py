"""Who connects to the wrong place is told what is there, by every program, without waiting in silence."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from bridge.headset.client import Headset
from macs_zenoh.errors import Unreachable
from tests.support.certificates import Authority
from tests.support.programs import Program, ended, free_port
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until


@dataclass
class Site:
    """A router and a gateway."""

    router: Program
    gateway: Program

    @property
    def endpoint(self) -> str:
        return self.router.ready.removeprefix("router on ")

    @property
    def gateway_as_router(self) -> str:
        return f"tcp/127.0.0.1:{self.gateway.port}"


@pytest.fixture
async def site() -> AsyncIterator[Site]:
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Program("router", "-l", f"tcp/127.0.0.1:{free_port()}"))
        endpoint = router.ready.removeprefix("router on ")
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", "-e", endpoint))
        yield Site(router, gateway)


async def one_line(*argv: str) -> str:
    """What a verb that fails says: one line, exit code 1."""
    code, out, errors = await ended(*argv)
    assert (code, out) == (1, ""), errors
    (line,) = errors.splitlines()
    return line


@pytest.mark.parametrize("verb", ["ls", "stop"])
async def test_a_gateway_is_no_router(site: Site, verb: str) -> None:
    """`ls` and `stop` at a gateway's port end at once with what is there, and nothing of Zenoh's own log."""
    began = time.monotonic()
    line = await one_line(verb, "-e", site.gateway_as_router, "--timeout", "300")
    assert time.monotonic() - began < PATIENCE_S, "it did not wait for what cannot come"
    assert line.startswith(f"macs {verb}: {site.gateway_as_router} cannot be reached: that is a gateway")
    assert "7447" in line


async def test_programs_that_wait_say_what_they_wait_at(site: Site) -> None:
    """A gateway that is sent to a gateway says so while it waits, and the other one what has come."""
    waiting = Program("gateway", "--port", "0", "-e", site.gateway_as_router)
    starting = asyncio.create_task(waiting.start())
    while not any("that is a gateway" in line for line in waiting.log):
        assert not starting.done()
        await asyncio.sleep(0.05)
    assert not [line for line in waiting.log if "zenoh_transport" in line]
    while not any("is a Zenoh program" in line for line in site.gateway.log):
        await asyncio.sleep(0.05)
    starting.cancel()
    await waiting.stop()
    await until(lambda: len([line for line in site.gateway.log if "zenoh_program" in line]) == 1)


async def test_a_router_is_no_gateway(site: Site) -> None:
    """`macs headset` at a router's port says what is there, as its library does."""
    where = site.endpoint.removeprefix("tcp/")
    line = await one_line("headset", where, "online")
    assert line.startswith(f"macs headset: {where} cannot be reached: that is a Zenoh router")
    host, _, port = where.rpartition(":")
    with pytest.raises(Unreachable, match="that is a Zenoh router"):
        await Headset.connect(host, int(port), handshake_timeout_s=60)


async def test_an_endpoint_of_zenoh_is_no_gateway() -> None:
    """`tcp/…` in place of HOST:PORT is wrong usage that says how it is written."""
    code, _, errors = await ended("headset", "tcp/127.0.0.1:7447", "online")
    assert code == 2
    assert "is an endpoint of Zenoh's; say HOST:PORT" in errors.splitlines()[-1]


@pytest.mark.parametrize("verb", ["ls", "stop"])
async def test_why_no_router_answers(verb: str, tmp_path: Path) -> None:
    """An unknown host, a port where nobody listens, one that speaks TLS, and a CA that is not ours."""
    host = "nobody-has-this-name.invalid"
    assert "host name is not known" in await one_line(verb, "-e", f"tcp/{host}:7447", "--timeout", "1")
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    line = await one_line(verb, "-e", nowhere, "--timeout", "1")
    assert "no Zenoh router answered within 1 s: nobody listens there" in line
    both = await one_line(verb, "-e", nowhere, "-e", f"tcp/{host}:7447", "--timeout", "1")
    assert f"{nowhere}: nobody listens there" in both
    assert f"tcp/{host}:7447: this host name is not known" in both

    ours, theirs = Authority(tmp_path / "ours"), Authority(tmp_path / "theirs", "their CA")
    certificate, key = theirs.issue("router")
    tls = "transport/link/tls"
    overrides = [f"{tls}/listen_certificate:'{certificate}'", f"{tls}/listen_private_key:'{key}'"]
    async with Router(listen=[f"tls/127.0.0.1:{free_port()}"], overrides=overrides) as router:
        plain = router.endpoint.replace("tls/", "tcp/")
        assert "this port speaks TLS" in await one_line(verb, "-e", plain, "--timeout", "30")
        trusting = f"{tls}/root_ca_certificate:'{ours.ca}'"
        line = await one_line(verb, "-e", router.endpoint, "--cfg", trusting, "--timeout", "3")
        assert "from a CA that these settings do not trust" in line


@pytest.mark.parametrize(
    ("host", "open_"), [("127.0.0.1", False), ("[::1]", False), ("0.0.0.0", True), ("[::]", True)]
)
async def test_what_is_open_to_the_network_is_said(host: str, open_: bool) -> None:
    """A router and a gateway that others than this machine reach say so, with what to do."""
    async with Program("router", "-l", f"tcp/{host}:{free_port()}") as router:
        await until(lambda: any("is open: whoever reaches it" in line for line in router.log) is open_)
        endpoint = f"tcp/127.0.0.1:{router.port}" if "1" not in host.strip("[]") or host == "127.0.0.1" else ""
        endpoint = endpoint or router.ready.removeprefix("router on ")
        gateway = Program("gateway", "--host", host, "--port", "0", "-e", endpoint)
        async with gateway:
            await until(lambda: any("is open: whoever reaches it" in line for line in gateway.log) is open_)
        async with Program(
            "gateway", "--host", host, "--port", "0", "-e", endpoint, "--allow", "10.0.0.0/8"
        ) as gateway:
            assert not any("is open: whoever reaches it" in line for line in gateway.log)
