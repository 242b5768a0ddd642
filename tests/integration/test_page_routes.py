"""What a gateway tells browsers over HTTP: the page's files, the mesh, each robot, types; and whom."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
import traceback
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from bridge.gateway import Gateway
from bridge.page import definitions, files, mesh, robots, routes, traces
from bridge.page.fresh import Fresh
from bridge.tokens import store
from macs_zenoh import join
from macs_zenoh.errors import Refused, Unreachable
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
    monkeypatch.setattr(files, "missing", lambda found, *wanted: not there)
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
        timed = timed and all(router["roundTripMs"] for router in told["routers"])
        rated = [told["sessions"].get(each.mesh.zid, {}).get("bytesPerS") for each in (gateway, other)]
        timed = timed and (sys.platform != "linux" or all(rate is not None and rate >= 0 for rate in rated))
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
    start_gateway: StartGateway,
    session: aiohttp.ClientSession,
    asked: Asked,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
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
    assert await one.told("/view/me", Cookie="macs_token=macs_wrong") == {"wanted": True}
    assert "shows no valid token at the web port" in caplog.text  # whatever he asks for who tries them
    me = await one.told("/view/me", **cookie)
    assert (me["name"], me["may"], me["robots"], me["groups"], me["wanted"]) == ("anna", ["see"], [5], [], False)
    assert await one.told("/view/robots/5/status", **cookie) == STATUS
    assert "error" in await one.told("/view/robots/6/status", **cookie)
    assert "error" in await one.told("/types/6/own_msgs/msg/Level", **cookie)

    async def told_of_five() -> bool:
        robots = (await one.told("/view/mesh", **cookie))["robots"]
        assert [robot["id"] for robot in robots] == [5]
        return robots[0]["known"] is True

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


async def test_a_kept_problem_keeps_nothing_else_alive() -> None:
    """Whoever hears of it hears the same: what was at work is not remembered, and it does not grow."""

    async def ask() -> int:
        try:
            json.loads("no")
        except ValueError as error:
            raise Unreachable("robot 7", "its answer makes no sense") from error
        return 1

    fresh, lengths = Fresh(ask, 1000.0), []
    for _ in range(5):
        with pytest.raises(Unreachable) as raised:
            await fresh.now()
        assert raised.value.__cause__ is raised.value.__context__ is None
        lengths.append(len(traceback.extract_tb(raised.value.__traceback__)))
    assert len(set(lengths)) == 1
    fresh.close()


async def test_nothing_is_remembered_of_robots_that_are_not_there(
    start_gateway: StartGateway, session: aiohttp.ClientSession, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever asks for each id there could be costs a gateway nothing that stays; nor does who makes up types."""
    made: list[robots.Robots] = []
    made_types: list[definitions.Definitions] = []
    keep(monkeypatch, routes, "Robots", made)
    keep(monkeypatch, routes, "Definitions", made_types)
    gateway = await start_gateway(web_port=0)
    one = Browser(session, gateway)
    await until(lambda: gateway.directory.ids(ROS) == [5, 6])
    for number in (1, 77, 65_535, 99_999):
        for what in ("status", "offers"):
            told = await one.told(f"/view/robots/{number}/{what}")
            assert told == {"error": f"robot {number} is not online"}
        assert "not online" in (await one.told(f"/view/trace/{number}?topic=/a"))["error"]
        assert "nobody here" in (await one.told(f"/types/{number}/own_msgs/msg/Level"))["error"]
    assert not made[0]._asked
    monkeypatch.setattr(definitions, "KEPT", 10)
    for number in range(30):
        assert "nobody here" in (await one.told(f"/types/5/own_msgs/msg/Other{number}"))["error"]
    before = asked.counts[5, "definitions"]
    assert "nobody here" in (await one.told("/types/5/own_msgs/msg/Other29"))["error"]
    assert asked.counts[5, "definitions"] == before == 30
    assert len(made_types[0]._unknown) == 10


def keep(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, made: list[Any]) -> None:
    """Note what a module makes of a class."""
    original = getattr(module, name)

    def make(*arguments: Any) -> Any:
        made.append(original(*arguments))
        return made[-1]

    monkeypatch.setattr(module, name, make)


async def test_a_robot_that_nobody_looks_at_is_forgotten(
    start_gateway: StartGateway, session: aiohttp.ClientSession, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where nobody looks at the mesh."""
    made: list[robots.Robots] = []
    keep(monkeypatch, routes, "Robots", made)
    monkeypatch.setattr(robots, "FORGET_S", 0.0)
    gateway = await start_gateway(web_port=0)
    one = Browser(session, gateway)
    await until(lambda: gateway.directory.ids(ROS) == [5, 6])
    assert await one.told("/view/robots/5/status") == STATUS
    assert await one.told("/view/robots/6/status") == STATUS
    assert [*made[0]._asked] == [(6, "status")]


async def test_types_of_everybody_are_loaded_beside_the_loop(
    start_gateway: StartGateway, session: aiohttp.ClientSession, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames do not wait for it, and it is done once for all who ask meanwhile."""
    threads: list[int] = []
    load = definitions._load

    def noted() -> Any:
        threads.append(threading.get_ident())
        return load()

    monkeypatch.setattr(definitions, "_load", noted)
    one = Browser(session, await start_gateway(web_port=0))
    told = await asyncio.gather(*(one.told("/types/5/geometry_msgs/msg/Twist") for _ in range(5)))
    assert all("float64 x" in each["text"] or "linear" in each["text"] for each in told)
    assert len(threads) == 1
    assert threads[0] != threading.get_ident()


HOSTILE = [
    *({"stop": value} for value in ("x", 5, [1])),
    *({"nodes": value} for value in (5, "x", [5], [{}], [{"name": ["a"]}], [{"name": "a", "control": "x"}])),
    {"nodes": [{"name": "a", "control": {"holder": {"a": 1}}}]},
    *({"drops": value} for value in (5, ["x"], {"a": "b"}, {"a": {"b": 1}})),
    {"stopped": "yes"},
]


@pytest.mark.parametrize("said", HOSTILE, ids=json.dumps)
def test_a_state_that_makes_no_sense_is_unknown(said: dict[str, Any]) -> None:
    """One robot that answers whatever it likes takes the mesh from nobody."""
    assert mesh._state({**STATUS, **said}) == {"known": False}


def test_of_a_state_only_so_much_is_shown() -> None:
    """To everybody who looks, twice a second."""
    nodes = [
        {"name": "/a", "control": {"holder": "unity/5"}},
        {"name": "/b", "more": 1},
        {"name": "/c", "control": {}},
    ]
    shown = mesh._state({**STATUS, "nodes": nodes, "drops": {str(number): 1 for number in range(10_000)}})
    assert (shown["known"], shown["stopped"], shown["stoppedBy"]) == (True, True, "unity/5")
    assert shown["control"] == {"/a": "unity/5"}
    assert len(shown["drops"]) == mesh.DROPS
    assert mesh._state(None) == {"known": False}
    assert len(mesh._state({**STATUS, "stop": {"by": "x" * 100_000}})["stoppedBy"]) < 1000


async def test_a_hostile_robot_takes_the_mesh_from_nobody(
    start_gateway: StartGateway, session: aiohttp.ClientSession, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others are shown as before."""
    gateway = await start_gateway(web_port=0)
    one = Browser(session, gateway)
    monkeypatch.setitem(STATUS, "nodes", [{"name": []}])

    async def answered() -> bool:
        robots = (await one.told("/view/mesh"))["robots"]
        return len(robots) == 2 and asked.counts[5, "status"] > 1

    await until(answered)
    monkeypatch.setitem(STATUS, "nodes", [])

    async def known() -> bool:
        return all(robot["known"] for robot in (await one.told("/view/mesh"))["robots"])

    await until(known)


HALF = {"nodes": [{"name": "\ud800", "control": {"holder": "unity/5"}}], "drops": {"\udfff": 1}}


@pytest.mark.parametrize(
    "said", [HALF, {"drops": {"a": float("nan")}}, {"more": float("inf")}, {"more": [[[[{}]]]] * 40_000}]
)
async def test_what_no_browser_could_read_is_told_to_none(
    start_gateway: StartGateway,
    session: aiohttp.ClientSession,
    asked: Asked,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    said: dict[str, Any],
) -> None:
    """Half a character or a number that is none, in what one robot says, costs that robot, and is no fault of ours."""
    one = Browser(session, await start_gateway(web_port=0))
    for name, value in said.items():
        monkeypatch.setitem(STATUS, name, value)
    await until(lambda: one.told("/view/mesh"))

    async def answered() -> bool:
        robots = (await one.told("/view/mesh"))["robots"]
        return len(robots) == 2 and asked.counts[5, "status"] > 1

    await until(answered)
    told = await one.told("/view/robots/5/status")
    assert "makes no sense" in told["error"]
    assert not [record for record in caplog.records if record.exc_info]


async def test_a_group_s_token_sees_the_robots_of_its_group(
    start_gateway: StartGateway, router: str, session: aiohttp.ClientSession, tmp_path: Path
) -> None:
    """And of others not even that they are there, nor their sessions; who may not look is shown no state."""
    path, secrets = tmp_path / "tokens.json", {}
    for name, may in (("looks", ["see"]), ("stops", ["stop"])):
        secrets[name] = new_secret(os.urandom(32))
        token = Token(name=name, rights=Rights(may=may, groups=[3]), hashes=[hash_of(secrets[name])])
        store.change(path, lambda tokens, token=token: (tokens.with_token(token), None))
    async with AsyncExitStack() as stack:
        zids = {}
        for number, group in ((5, 3), (6, 4)):
            agent = await stack.enter_async_context(join(ROS, id=number, group=group, settings=patient(router)))
            agent.serve("status", lambda call: answer_status())
            zids[number] = agent.mesh.zid
        gateway = await start_gateway(web_port=0, web_without_token="nobody", tokens_file=str(path))
        one = Browser(session, gateway)
        await until(lambda: gateway.directory.ids(ROS) == [5, 6])
        looks, stops = ({"Cookie": f"macs_token={secrets[name]}"} for name in ("looks", "stops"))

        async def seen() -> bool:
            told = await one.told("/view/mesh", **looks)
            assert [robot["id"] for robot in told["robots"]] == [5]
            assert zids[6] not in told["sessions"]
            return told["robots"][0]["known"] and zids[5] in told["sessions"]

        await until(seen)
        (robot,) = (await one.told("/view/mesh", **stops))["robots"]
        assert (robot["id"], robot["known"]) == (5, False)
        assert await one.told("/view/robots/5/status", **looks) == STATUS
        for number, who in ((6, looks), (5, stops)):
            assert "does not give the right" in (await one.told(f"/view/robots/{number}/status", **who))["error"]


async def answer_status() -> bytes:
    return json.dumps(STATUS).encode()


async def test_whose_trace_is_awaited_does_not_lose_it_to_another(
    start_gateway: StartGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So many topics are traced at one time, and one more is refused; once one is done, another takes its place."""
    gateway = await start_gateway()
    made = traces.Traces(gateway.mesh, gateway.directory, robots.Robots(gateway.mesh).ask)
    done = {f"/{number}": asyncio.Event() for number in range(traces.TOPICS + 1)}

    async def collect(_: traces.Traces, robot: int, topic: str) -> list[dict[str, Any]]:
        await done[topic].wait()
        return [{"topic": topic}]

    monkeypatch.setattr(traces.Traces, "_collect", collect)
    *first, late = done
    asking = {topic: asyncio.create_task(made.of(5, topic)) for topic in first}
    await asyncio.sleep(0)
    with pytest.raises(Refused, match="16 topics are traced"):
        await made.of(5, late)
    done[first[3]].set()
    assert await asking.pop(first[3]) == [{"topic": first[3]}]
    done[late].set()
    assert await made.of(5, late) == [{"topic": late}]
    assert len(made._kept) == traces.TOPICS
    for topic, task in asking.items():
        done[topic].set()
        assert await task == [{"topic": topic}]
    made.close()


async def test_a_trace_takes_the_right_to_see_its_topic(
    start_gateway: StartGateway, session: aiohttp.ClientSession, asked: Asked, tmp_path: Path
) -> None:
    """A token's topics count for what is traced as for what is seen."""
    path, secret = tmp_path / "tokens.json", new_secret(os.urandom(32))
    rights = Rights(may=["see"], robots=[5], topics=["/camera/**"])
    token = Token(name="anna", rights=rights, hashes=[hash_of(secret)])
    store.change(path, lambda tokens: (tokens.with_token(token), None))
    gateway = await start_gateway(web_port=0, web_without_token="nobody", tokens_file=str(path))
    one, cookie = Browser(session, gateway), {"Cookie": f"macs_token={secret}"}
    await until(lambda: gateway.directory.ids(ROS) == [5, 6])
    for topic in ("/scan", "", "camera/image"):
        assert "this token" in (await one.told(f"/view/trace/5?topic={topic}", **cookie))["error"]
    assert "not give the right" in (await one.told("/view/trace/6?topic=/camera/image", **cookie))["error"]
    assert await one.told("/view/trace/5?topic=/camera/image", **cookie) == {"ways": []}
