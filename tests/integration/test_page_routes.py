"""What a gateway tells browsers over HTTP: the page's files, the mesh, each robot, types; and whom."""

from __future__ import annotations

import asyncio
import json
import os
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from bridge.gateway import Gateway
from bridge.page import files, routes
from bridge.page.fresh import Fresh
from bridge.tokens import store
from macs_zenoh import join
from macs_zenoh.errors import Unreachable
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from macs_zenoh.serving import Call
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.waiting import until

STATUS = {"ros_node": "/r", "stopped": True, "stop": {"by": "unity/5"}, "nodes": [], "drops": {"bad_cdr": 2}}
OFFERS = {"subscribers": {"/cmd_vel": "geometry_msgs/msg/Twist"}, "publishers": {}, "services": {}, "actions": {}}
TEXT = "uint8 level\n"


class Asked:
    """Robots 5 and 6, which count what they are asked."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[int, str]] = Counter()

    async def answer(self, robot: int, verb: str, call: Call) -> bytes:
        self.counts[robot, verb] += 1
        if verb == "definitions":
            (name,) = json.loads(call.data)["types"]
            found = {name: {"text": TEXT}} if name == "own_msgs/msg/Level" else {}
            return json.dumps({"definitions": found, "missing": {} if found else {name: "unknown"}}).encode()
        return json.dumps({"status": STATUS, "offers": OFFERS}[verb]).encode()


@pytest.fixture
async def asked(router: str) -> AsyncIterator[Asked]:
    """They are online."""
    counted = Asked()
    async with AsyncExitStack() as stack:
        for number in (5, 6):
            agent = await stack.enter_async_context(join(ROS, id=number, settings=patient(router)))
            for verb in ("status", "offers", "definitions"):
                agent.serve(verb, lambda call, n=number, v=verb: counted.answer(n, v, call))
        yield counted


class Browser:
    """Asks a gateway, as one page."""

    def __init__(self, session: aiohttp.ClientSession, gateway: Gateway) -> None:
        self._session = session
        self._base = f"http://127.0.0.1:{gateway.listeners.web_port}"

    async def get(self, path: str, **headers: str) -> aiohttp.ClientResponse:
        response = await self._session.get(self._base + path, headers=headers)
        await response.read()
        return response

    async def told(self, path: str, **headers: str) -> Any:
        response = await self.get(path, **headers)
        assert response.status == 200, await response.text()
        return json.loads(await response.read())


@pytest.fixture
async def session() -> AsyncIterator[aiohttp.ClientSession]:
    """Of a browser."""
    async with aiohttp.ClientSession(auto_decompress=True) as made:
        yield made


async def test_files_are_ours_and_come_once(start_gateway: StartGateway, session: aiohttp.ClientSession) -> None:
    """Each file has its type and forbids all that is from elsewhere; who has it gets it again only when it changed."""
    one = Browser(session, await start_gateway(web_port=0))
    script = await one.get("/macs.js")
    assert script.headers["Content-Type"] == "text/javascript; charset=utf-8"
    assert await script.read() == (files.FOLDER / "macs.js").read_bytes()
    assert script.headers["Content-Encoding"] == "gzip"
    assert "default-src 'none'" in script.headers["Content-Security-Policy"]
    assert script.headers["X-Content-Type-Options"] == "nosniff"
    assert (await one.get("/macs.js", **{"If-None-Match": script.headers["ETag"]})).status == 304
    assert (await one.get("/page/page.css")).headers["Content-Type"] == "text/css; charset=utf-8"
    for outside in ("/../pyproject.toml", "/page/../../routes.py", "/%2e%2e/routes.py", "/npm/package.json", "/page"):
        assert (await one.get(outside)).status == 404


async def test_a_listed_page_may_use_our_modules(start_gateway: StartGateway, session: aiohttp.ClientSession) -> None:
    """A page whose origin the settings name may import and read what is here; others may not even ask."""
    one = Browser(session, await start_gateway(web_port=0, web_origins=["https://hall.example.org"]))
    listed = await one.get("/macs.js", Origin="https://hall.example.org")
    assert listed.headers["Access-Control-Allow-Origin"] == "https://hall.example.org"
    assert (await one.get("/macs.js", Origin="https://evil.example")).status == 403
    assert "Access-Control-Allow-Origin" not in (await one.get("/macs.js")).headers


@pytest.mark.parametrize("there", [True, False])
async def test_without_libraries_the_page_says_what_to_do(
    start_gateway: StartGateway, session: aiohttp.ClientSession, monkeypatch: pytest.MonkeyPatch, there: bool
) -> None:
    """Where nothing was fetched from npm the page is one line that names the command; else it is the page."""
    monkeypatch.setattr(files, "missing", lambda found: not there)
    one = Browser(session, await start_gateway(web_port=0))
    text = await (await one.get("/")).text()
    assert ("make page" in text) is not there
    assert ("/page/app.js" in text) is there


async def test_files_cost_only_so_much(
    start_gateway: StartGateway, session: aiohttp.ClientSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who asks for more in a second than a gateway gives is told to wait, and others get what they ask for."""
    monkeypatch.setattr(routes, "BYTES_PER_S", 60_000.0)
    one = Browser(session, await start_gateway(web_port=0))
    answers = [(await one.get("/macs.js")).status for _ in range(40)]
    assert {200, 503} == set(answers)
    assert (await one.told("/view/me"))["may"]


async def test_many_pages_cost_a_robot_what_one_does(
    start_gateway: StartGateway, session: aiohttp.ClientSession, asked: Asked
) -> None:
    """However many look at a robot, it is asked once; and again when the answer has aged."""
    gateway = await start_gateway(web_port=0)
    one = Browser(session, gateway)
    await until(lambda: gateway.directory.ids(ROS) == [5, 6])
    answers = await asyncio.gather(*(one.told("/view/robots/5/status") for _ in range(50)))
    assert answers == [STATUS] * 50
    assert asked.counts[5, "status"] <= 2
    await until(lambda: asked_again(one, asked))
    assert await one.told("/view/robots/5/offers") == OFFERS
    assert asked.counts[6, "status"] == 0


async def asked_again(one: Browser, asked: Asked) -> bool:
    await one.told("/view/robots/5/status")
    return asked.counts[5, "status"] > 2


async def test_the_mesh_is_told_as_far_as_it_is_known(
    start_gateway: StartGateway, session: aiohttp.ClientSession, asked: Asked
) -> None:
    """Robots with their state, the sessions behind them with their round trip, gateways, routers."""
    gateway, other = await start_gateway(web_port=0), await start_gateway()
    one = Browser(session, gateway)

    async def whole() -> Any:
        told = await one.told("/view/mesh")
        robots = {robot["id"]: robot for robot in told["robots"]}
        known = {5, 6} == set(robots) and all(robot["known"] for robot in robots.values())
        behind = {other.mesh.zid, *(robot["session"] for robot in robots.values())}
        timed = all(told["sessions"].get(zid, {}).get("roundTripMs") for zid in behind)
        return told if known and timed and len(told["gateways"]) == 2 and told["routers"] else None

    told = await until(whole)
    assert told["own"] == gateway.mesh.zid
    assert set(told["gateways"]) == {gateway.mesh.zid, other.mesh.zid}
    robot = told["robots"][0]
    assert (robot["stopped"], robot["stoppedBy"], robot["drops"]) == (True, "unity/5", {"bad_cdr": 2})
    assert told["sessions"][other.mesh.zid]["address"] == other.mesh.address
    (shown,) = told["routers"]
    assert shown["linked"]
    assert {robot["session"] for robot in told["robots"]} <= set(shown["sessions"])


async def test_types_are_those_of_the_robot(
    start_gateway: StartGateway, session: aiohttp.ClientSession, asked: Asked
) -> None:
    """What a robot tells of its types counts, asked once; what it does not know is a standard type, or unknown."""
    gateway = await start_gateway(web_port=0)
    one = Browser(session, gateway)
    await until(lambda: gateway.directory.ids(ROS) == [5, 6])
    for _ in range(3):
        assert await one.told("/types/5/own_msgs/msg/Level") == {"text": TEXT}
    assert asked.counts[5, "definitions"] == 1
    assert "float64 x" in (await one.told("/types/5/geometry_msgs/msg/Twist"))["text"]
    assert (await one.told("/types/5/std_srvs/srv/SetBool_Request"))["text"] == "bool data\n"
    assert "own_msgs/msg/Other" in (await one.told("/types/5/own_msgs/msg/Other"))["error"]
    assert "text" in await one.told("/types/77/geometry_msgs/msg/Twist")  # a robot that is not there


async def test_who_has_a_token_is_told_what_it_permits(
    start_gateway: StartGateway, session: aiohttp.ClientSession, asked: Asked, tmp_path: Path
) -> None:
    """The page learns what to offer; robots that are not the token's tell it nothing; without one it asks for one."""
    path, secret = tmp_path / "tokens.json", new_secret(os.urandom(32))
    token = Token(name="anna", rights=Rights(may=["see"], robots=[5]), hashes=[hash_of(secret)])
    store.change(path, lambda tokens: (tokens.with_token(token), None))
    gateway = await start_gateway(web_port=0, web_without_token="nobody", tokens_file=str(path))
    one, cookie = Browser(session, gateway), {"Cookie": f"macs_token={secret}"}
    await until(lambda: gateway.directory.ids(ROS) == [5, 6])
    assert await one.told("/view/me") == {"wanted": True}
    assert (await one.get("/view/mesh")).status == (await one.get("/view/robots/5/status")).status == 401
    me = await one.told("/view/me", **cookie)
    assert (me["name"], me["may"], me["robots"], me["wanted"]) == ("anna", ["see"], [5], False)
    assert await one.told("/view/robots/5/status", **cookie) == STATUS
    assert "error" in await one.told("/view/robots/6/status", **cookie)
    assert "error" in await one.told("/types/6/own_msgs/msg/Level", **cookie)

    async def told_of_five() -> bool:
        known = {robot["id"]: robot["known"] for robot in (await one.told("/view/mesh", **cookie))["robots"]}
        assert known[6] is False
        return known[5] is True

    await until(told_of_five)
    assert asked.counts[6, "status"] == asked.counts[6, "definitions"] == 0


async def test_an_answer_is_asked_for_once() -> None:
    """Who wants it while it is asked for waits for the same; who cannot have it is told why, and may ask again."""
    loop, counts = asyncio.get_running_loop(), Counter[str]()
    problem: list[Unreachable] = []

    async def ask() -> int:
        counts["asked"] += 1
        await asyncio.sleep(0)
        if problem:
            raise problem[0]
        return counts["asked"]

    fresh = Fresh(ask, 1000.0)
    assert fresh.last() is None
    assert await asyncio.gather(*(fresh.now() for _ in range(20))) == [1] * 20
    assert (fresh.last(), await fresh.now()) == (1, 1)
    assert fresh.wanted_at <= loop.time()
    problem.append(Unreachable("robot 7", "no answer"))
    assert fresh.last(0.0) == 1
    with pytest.raises(Unreachable):
        await fresh.now()
    problem.clear()
    assert fresh.last(0.0) is None
    assert await fresh.now() == 3
    fresh.close()
