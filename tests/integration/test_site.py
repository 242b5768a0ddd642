"""What the web port answers besides WebSockets: whom, and with which rights."""

from __future__ import annotations

import os
from pathlib import Path

import aiohttp
import pytest
from aiohttp import web

from bridge.gateway import web as web_port
from bridge.gateway.site import Site
from bridge.tokens import store
from macs_zenoh.protocol.rights import Grant, Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.support.given import StartGateway


def add_a_page(site: Site) -> None:
    """A page for those who may come, and one for all."""

    async def inside(request: web.Request, visitor: Grant) -> web.StreamResponse:
        may = "all" if visitor.rights is None else ",".join(visitor.rights.may)
        return web.Response(text=f"{visitor.name or 'nobody'} may {may} at {site.gateway.port}")

    async def outside(request: web.Request) -> web.StreamResponse:
        return web.Response(text="in" if site.visitor(request) else "out", headers={"Cache-Control": "no-cache"})

    site.get("/inside", inside)
    site.get_for_all("/outside", outside)


async def test_a_module_adds_pages_for_who_may_come(
    start_gateway: StartGateway, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Where a token is wanted it is shown in a header or a cookie, and holds as long as it is in the file; where none
    is, only a wrong one is refused. A page for all is for all."""
    monkeypatch.setattr(web_port, "add_routes", add_a_page)
    path, secret = tmp_path / "tokens.json", new_secret(os.urandom(32))
    token = Token(name="anna", rights=Rights(may=["see"]), hashes=[hash_of(secret)])
    store.change(path, lambda tokens: (tokens.with_token(token), None))
    gateway = await start_gateway(web_port=0, web_without_token="nobody", tokens_file=str(path))
    free = await start_gateway(web_port=0, tokens_file=str(path))

    async with aiohttp.ClientSession() as session:

        async def get(of: object, page: str, **headers: str) -> tuple[int, str]:
            address = f"http://127.0.0.1:{of.listeners.web_port}/{page}"  # type: ignore[attr-defined]
            async with session.get(address, headers=headers) as response:
                return response.status, await response.text()

        good = (200, f"anna may see at {gateway.port}")
        assert await get(gateway, "inside", Authorization=f"Bearer {secret}") == good
        assert await get(gateway, "inside", Cookie=f"macs_token={secret}") == good
        assert await get(gateway, "outside", Cookie=f"macs_token={secret}") == (200, "in")
        assert await get(gateway, "outside") == (200, "out")
        for headers in (
            {},
            {"Authorization": "Bearer x"},
            {"Cookie": "macs_token=x"},
            {"Authorization": "Basic eA=="},
        ):
            assert (await get(gateway, "inside", **headers))[0] == 401
        anybody = (200, f"nobody may all at {free.port}")
        assert await get(free, "inside") == await get(free, "inside", Cookie="macs_token=x") == anybody
        assert (await get(free, "inside", Authorization="Bearer x"))[0] == 401
        assert (await get(free, "inside", Origin="http://evil.example"))[0] == 403
        store.change(path, lambda tokens: (tokens.without("anna"), None))
        assert (await get(gateway, "inside", Cookie=f"macs_token={secret}"))[0] == 401
