"""Figures, health and diagnostics of real programs, over HTTP."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import subprocess
import time
from collections import Counter
from contextlib import AsyncExitStack
from typing import Any

import aiohttp
import pytest

from bridge.gateway import figures
from bridge.headset.client import Headset
from bridge.metrics import answers
from bridge.metrics.endpoint import AT_ONCE_EACH
from bridge.tokens import store
from macs_zenoh.protocol.messages import Configuration, encode_management
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from macs_zenoh.protocol.wire import encode_frame
from tests.support.given import Connect, StartGateway
from tests.support.programs import Program, free_port
from tests.support.waiting import until

TOO_MANY = "too_many_from_address"


async def get(url: str, **headers: str) -> tuple[int, str]:
    """Status and text."""
    async with aiohttp.ClientSession() as session, session.get(url, headers=headers) as response:
        return response.status, await response.text()


def told_at(program: Program) -> str:
    """Where a program tells its figures."""
    (line,) = [line for line in program.log if "figures at " in line]
    return line.partition("figures at ")[2].removesuffix("/metrics").strip()


def figure(text: str, name: str, **labels: str) -> float:
    """The value of one figure."""
    inside = ",".join(f'{key}="{value}"' for key, value in sorted(labels.items()))
    wanted = name + (f"{{{inside}}}" if inside else "")
    (value,) = [line.rpartition(" ")[2] for line in text.splitlines() if line.rpartition(" ")[0] == wanted]
    return float(value)


async def test_router_and_gateway_tell_who_watches() -> None:
    """Figures at a port of their own, and at a web port as well; ready while there is a router, and why not."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Program("router", "-l", endpoint, "--metrics", "127.0.0.1:0"))
        argv = ("gateway", "--port", "0", "--web-port", str(web := free_port()), "--metrics", "127.0.0.1:0")
        gateway = await stack.enter_async_context(Program(*argv, "-e", endpoint))
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port, group=3))

        async def seen() -> bool:
            return 'macs_agents{type="unity"} 1.0' in (await get(f"{told_at(gateway)}/metrics"))[1]

        await until(seen, every_s=0.05)
        for where in (told_at(gateway), f"http://127.0.0.1:{web}"):
            status, text = await get(f"{where}/metrics")
            assert status == 200
            assert figure(text, "macs_own_agents", type="unity") == 1
            assert figure(text, "macs_agents", type="unity") == 1
            assert figure(text, "macs_linked") == figure(text, "macs_ready") == 1
            assert figure(text, "macs_agent_bytes_total", direction="in") > 50
            assert figure(text, "macs_agent_bytes_total", direction="out") > 50
            assert (await get(f"{where}/healthz"))[0] == (await get(f"{where}/readyz"))[0] == 200
            said = json.loads((await get(f"{where}/diagnostics"))[1])
            assert (said["program"], said["agents"], said["ready"]) == ("gateway", {"unity": 1}, True)
            assert said["address"] == gateway.ready.removeprefix("gateway on ")
        _, text = await get(f"{told_at(router)}/metrics")
        assert figure(text, "macs_sessions", type="client") == 1
        assert figure(text, "macs_ready") == 1
        assert headset.id

        await router.stop()
        where = told_at(gateway)

        async def not_ready() -> bool:
            return await get(f"{where}/readyz") == (503, "no router is connected\n")

        await until(not_ready, every_s=0.05)
        assert (await get(f"{where}/healthz"))[0] == 200

        async def told() -> bool:  # figures are good for a moment
            return figure((await get(f"{where}/metrics"))[1], "macs_linked") == 0

        await until(told, every_s=0.05)
        await until(lambda: any(f"router {endpoint} lost; reconnecting" in line for line in gateway.log))
        assert any(re.search(rf"router {endpoint} connected \([0-9a-f]{{8}}\)", line) for line in gateway.log)
        assert any(re.search(r"client [0-9a-f]{8} at tcp/127\.0\.0\.1:\d+ is linked", line) for line in router.log)


async def test_what_is_no_request_costs_nothing() -> None:
    """Too long, too slow, of another page, or none at all: refused or closed, and the next one is answered."""
    async with Program("router", "-l", f"tcp/127.0.0.1:{free_port()}", "--metrics", "127.0.0.1:0") as router:
        where = told_at(router)
        host, port = where.removeprefix("http://").split(":")

        async def said(request: bytes) -> bytes:
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(request)
            try:
                return await reader.read(1 << 20)
            except ConnectionError:
                return b""
            finally:
                writer.close()

        assert b" 400 " in await said(b"hello\r\n\r\n")
        assert b" 405 " in await said(b"POST /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert b" 403 " in await said(b"GET /metrics HTTP/1.1\r\nHost: evil.example\r\n\r\n")
        assert b" 404 " in await said(b"GET /../etc/passwd HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert await said(b"GET /" + b"a" * 100_000) == b""
        slow, slow_writer = await asyncio.open_connection(host, int(port))
        idle = [await asyncio.open_connection(host, int(port)) for _ in range(40)]
        assert await said(b"x") == b""  # there is no place for it
        for _, writer in idle:
            writer.close()

        async def answered() -> bool:
            return (await said(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")).endswith(b"ok\n")

        await until(answered, every_s=0.05)
        counted = figure((await get(f"{where}/metrics"))[1], "macs_drops_total", where="metrics", counter=TOO_MANY)
        assert counted >= 40 + 1 - AT_ONCE_EACH
        assert await slow.read() == b""  # in its time
        slow_writer.close()

        async def is_counted(counter: str) -> bool:
            text = (await get(f"{where}/metrics"))[1]
            return (
                f'counter="{counter}"' in text
                and figure(text, "macs_drops_total", where="metrics", counter=counter) >= 1
            )

        await until(lambda: is_counted("slow_request"), every_s=0.6)  # figures are given again for half a second
        await until(lambda: is_counted("large_request"), every_s=0.6)


async def test_one_address_does_not_take_all_places() -> None:
    """Whoever watches is told, whatever somebody else holds open; and who asks all the time is told what was so."""
    async with Program("router", "-l", f"tcp/127.0.0.1:{free_port()}", "--metrics", "127.0.0.1:0") as router:
        host, port = told_at(router).removeprefix("http://").split(":")
        held = [await asyncio.open_connection(host, int(port)) for _ in range(40)]
        watching = aiohttp.TCPConnector(local_addr=("127.0.0.2", 0), force_close=True)
        async with aiohttp.ClientSession(connector=watching) as session:
            for _ in range(5):
                async with session.get(f"http://{host}:{port}/metrics") as response:
                    assert response.status == 200
        for _, writer in held:
            writer.close()


async def test_a_token_is_wanted_where_the_port_wants_one(start_gateway: StartGateway, tmp_path: Any) -> None:
    """Figures and diagnostics are for who shows one; whether it lives and is ready is for all."""
    path, secret = tmp_path / "tokens.json", new_secret(b"x" * 32)
    token = Token(name="prometheus", rights=Rights(may=["see"]), hashes=[hash_of(secret)])
    store.change(path, lambda tokens: (tokens.with_token(token), None))
    gateway = await start_gateway(web_port=0, web_without_token="nobody", tokens_file=str(path))
    where = f"http://127.0.0.1:{gateway.listeners.web_port}"
    for page in ("metrics", "diagnostics"):
        assert (await get(f"{where}/{page}"))[0] == 401
        assert (await get(f"{where}/{page}", Authorization=f"Bearer {secret}"))[0] == 200
    for page in ("healthz", "readyz"):
        assert (await get(f"{where}/{page}"))[0] == 200


async def test_who_asks_again_and_again_is_told_the_same(
    start_gateway: StartGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Working figures out takes the loop the longer the more agents there are: it is done once for a while, whoever
    asks and in whatever version he wants them, and then anew."""
    gateway = await start_gateway(web_port=0)
    where = f"http://127.0.0.1:{gateway.listeners.web_port}"
    now, worked_out = [1000.0], Counter[str]()
    carried, tells = gateway.carried, gateway.mesh.tells
    monkeypatch.setattr(gateway, "carried", lambda: worked_out.update(["metrics"]) or carried())
    monkeypatch.setattr(gateway.mesh, "tells", lambda: worked_out.update(["diagnostics"]) or tells())
    monkeypatch.setattr(figures, "monotonic", lambda: now[0])
    accepted = ("", *(f"{answers.OPEN_METRICS}; version={number}.0.0; escaping=x{number}" for number in range(5)))
    for times in (1, 2):
        for accept in accepted:
            status, text = await get(f"{where}/metrics", Accept=accept)
            assert status == 200
            assert text.endswith("# EOF\n") is bool(accept)
            assert json.loads((await get(f"{where}/diagnostics", Accept=accept))[1])["program"] == "gateway"
        assert worked_out == {"metrics": 2 * times, "diagnostics": 2 * times}
        now[0] += answers.GOOD_S + 0.01


async def test_a_thousand_agents_make_no_more_figures(
    start_gateway: StartGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a thousand agents a gateway tells at most 200 series, and Prometheus' own tool finds no fault in them."""
    gateway = await start_gateway(web_port=0)
    where = f"http://127.0.0.1:{gateway.listeners.web_port}"
    sockets = []
    try:
        for number in range(1000):
            sock = socket.create_connection(("127.0.0.1", gateway.port))
            sockets.append(sock)
            management = encode_management(Configuration(agent_type=2, agent_id=0, group_id=number % 250 + 1))
            sock.sendall(encode_frame(management=management))
            if number % 50 == 0:
                await asyncio.sleep(0)
        await until(lambda: len(list(gateway.agents.online())) == 1000, every_s=0.05)
        began = time.monotonic()
        status, text = await get(f"{where}/metrics")
        took_s = time.monotonic() - began
        assert status == 200
        assert figure(text, "macs_own_agents", type="unity") == 1000
        series = [line for line in text.splitlines() if line and not line.startswith("#")]
        assert len(series) <= 200
        print(f"{len(series)} series in {1000 * took_s:.1f} ms")
        if shutil.which("promtool"):
            checked = subprocess.run(
                ["promtool", "check", "metrics"], input=text, capture_output=True, text=True, check=False
            )
            assert checked.returncode == 0, checked.stdout + checked.stderr
    finally:
        for sock in sockets:
            sock.close()
