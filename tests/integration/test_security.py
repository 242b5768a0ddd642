"""A policy on real routers with mutual TLS: who gets in, who may what, and whether `macs security check` notices."""

from __future__ import annotations

import asyncio
import datetime as dt
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

import macs_zenoh
from bridge.gateway import Gateway
from bridge.headset.client import Headset
from bridge.security import certificates, policy
from bridge.security.attempts import Result
from bridge.security.check import check
from bridge.security.files import client_overrides
from bridge.security.generate import generate
from bridge.security.policy import Policy
from bridge.settings import load
from macs_zenoh import awareness, config
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import NotServed, Refused, Unreachable
from macs_zenoh.mesh import Mesh, Sample
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.protocol.messages import Metadata, NodeType, StreamData, encode_management
from macs_zenoh.protocol.named import Outcome
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.sections import changed
from macs_zenoh.streams import Streams
from tests.integration.test_reliable import Numbers, Stream
from tests.support.programs import ROOT, Program, ended, free_port, macs
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

NOW = dt.datetime.now(dt.timezone.utc)

CLIENTS = """
robots:
  - {name: robot-7, id: 7, group: 3, awareness_name: drone7}
  - {name: robot-8, id: 8, group: 3, awareness_name: drone8}
  - {name: robot-9, id: 9, awareness_name: drone9}
gateways:
  - {name: hall-1, blocks: [1]}
  - {name: hall-2, blocks: [2]}
operators:
  - {name: anna}
permissions:
  - {who: hall-1, may: [command, see, call], whom: [robot-7, robot-8]}
  - {who: hall-2, may: see, whom: robot-7}
  - {who: gateways, may: message, whom: gateways}
  - {who: robot-7, may: message, whom: robot-8}
  - {who: robot-8, may: message, whom: robot-7}
  - {who: anna, may: call, verbs: [status], whom: robots}
"""


@dataclass
class Site:
    """A policy, its files, and where its first router is."""

    policy: Policy
    directory: Path

    def settings(self, name: str) -> MeshSettings:
        """What a node's own settings file says."""
        return load(self.directory / name / "macs.toml").mesh

    def file(self, name: str = "site") -> Path:
        return self.directory / name / "router.json5"

    @asynccontextmanager
    async def session(self, name: str, router: str | None = None) -> AsyncIterator[Mesh]:
        """A session with a node's certificate, on the first router or the one named."""
        settings = self.settings(name)
        if router is not None:
            settings = changed(settings, connect=self.router(router))
        async with await Mesh.open_once(settings, timeout_s=PATIENCE_S) as mesh:
            yield mesh

    def router(self, name: str) -> list[str]:
        return next(router for router in self.policy.routers if router.name == name).dialled

    async def wrong(self, endpoints: list[str] | None = None) -> list[Result]:
        """What the check finds."""
        return [one for one in await check(self.policy, self.directory, endpoints) if not one.as_expected]


def made(directory: Path, clients: str = CLIENTS, routers: int = 1) -> Site:
    """A site with one router, or with a second one that dials it."""
    lines = [f"  - {{name: site, addresses: [127.0.0.1], listen: ['tls/127.0.0.1:{free_port()}']}}"]
    if routers == 2:
        listen = f"tls/127.0.0.1:{free_port()}"
        lines.append(f"  - {{name: cloud, addresses: [127.0.0.1], listen: ['{listen}'], links: [site]}}")
    read = policy.parse("\n".join(["routers:", *lines]) + clients)
    generate(read, directory, NOW)
    return Site(read, directory)


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    """A site whose router runs."""
    found = made(tmp_path / "pki")
    async with Router(found.file()):
        yield found


def listening(mesh: Mesh, key: str) -> list[Sample]:
    """What arrives on an expression."""
    arrived: list[Sample] = []

    def take(batch: Iterator[Sample]) -> None:
        arrived.extend((key, bytes(payload)) for key, payload in batch)

    mesh.subscribe(key, take)
    return arrived


# -- by hand, pair of roles by pair of roles ------------------------------------------------------------------------

PUTS = [
    # who puts, who listens, with which subscription, what arrives of it, and what does not
    ("hall-1", "robot-7", "macs/to/ros/0/7/**", "macs/to/ros/0/7/unity/256", "macs/to/ros/0/7/unity/512"),
    ("hall-1", "robot-7", "macs/group/3/ros/**", "macs/group/3/ros/unity/256", "macs/group/3/ros/unity/512"),
    ("hall-1", "robot-7", "macs/all/**", "macs/all/unity/256", "macs/all/ros/8"),
    ("hall-2", "robot-7", "macs/all/**", None, "macs/all/unity/512"),
    ("hall-2", "robot-7", "macs/to/ros/0/7/**", None, "macs/to/ros/0/7/unity/512"),
    ("hall-1", "robot-9", "macs/to/ros/0/9/**", None, "macs/to/ros/0/9/unity/256"),
    ("hall-1", "robot-9", "macs/all/**", None, "macs/all/unity/256"),
    ("robot-7", "hall-1", "macs/to/unity/1/**", "macs/to/unity/1/256/ros/7", "macs/to/unity/1/256/ros/8"),
    ("robot-7", "hall-1", "macs/from/ros/7/**", "macs/from/ros/7/nd__x", None),
    ("robot-7", "hall-1", "macs/from/ros/8/**", None, "macs/from/ros/8/nd__x"),
    ("robot-8", "hall-2", "macs/to/unity/2/**", None, "macs/to/unity/2/512/ros/8"),
    ("robot-8", "hall-2", "macs/from/ros/8/**", None, "macs/from/ros/8/nd__x"),
    ("hall-1", "hall-2", "macs/to/unity/2/**", "macs/to/unity/2/512/unity/256", "macs/to/unity/2/512/unity/513"),
    ("hall-1", "hall-2", "macs/to/unity/1/**", None, "macs/to/unity/1/256/unity/256"),
    ("robot-7", "robot-8", "macs/ca/to/drone8/**", "macs/ca/to/drone8/t/by/drone7", "macs/ca/to/drone8/t/by/drone9"),
    ("robot-7", "robot-8", "macs/to/ros/0/8/**", None, "macs/to/ros/0/8/ros/7"),
    ("robot-9", "robot-8", "macs/ca/to/drone8/**", None, "macs/ca/to/drone8/t/by/drone9"),
    ("robot-7", "robot-8", "macs/ca/all/t/by/**", "macs/ca/all/t/by/drone7", "macs/ca/all/t/by/drone9"),
    ("robot-7", "robot-9", "macs/ca/all/t/by/**", None, "macs/ca/all/t/by/drone7"),
    ("robot-7", "robot-9", "macs/ca/to/drone8/**", None, "macs/ca/to/drone8/t/by/drone7"),
    ("hall-1", "robot-8", "macs/to/ros/0/7/**", None, "macs/to/ros/0/7/unity/256"),
    ("anna", "robot-7", "macs/to/ros/0/7/**", None, "macs/to/ros/0/7/operator/0"),
    ("robot-7", "anna", "macs/from/ros/7/**", None, "macs/from/ros/7/nd__x"),
    ("hall-1", "anna", "macs/to/ros/0/7/**", None, "macs/to/ros/0/7/unity/256"),
]


async def test_puts_and_subscriptions_by_role(site: Site) -> None:
    """Between each pair of roles what is permitted arrives; what is put or subscribed to without a right does not."""
    names = [client.name for client in site.policy.clients]
    async with AsyncExitStack() as stack:
        hears = {name: await stack.enter_async_context(site.session(name)) for name in names}
        says = {name: await stack.enter_async_context(site.session(name)) for name in names}
        arrived = [listening(hears[hearer], expression) for _, hearer, expression, *_ in PUTS]
        await settled(site, hears, says)
        for number, (sayer, _, _, permitted, forbidden) in enumerate(PUTS):
            for key in (forbidden, permitted):
                if key is not None:
                    says[sayer].put_unasked(key, b"%d" % number)
        await settled(site, hears, says)
        for number, (row, got) in enumerate(zip(PUTS, arrived, strict=True)):
            assert [key for key, payload in got if payload == b"%d" % number] == [row[3]] * (row[3] is not None), row


async def settled(site: Site, hears: dict[str, Mesh], says: dict[str, Mesh]) -> None:
    """Wait until everything declared and put so far has gone wherever it may go: twice through every queue."""
    own = {"robot-7": "ros/0/7", "robot-8": "ros/0/8", "robot-9": "ros/0/9", "hall-1": "unity/1/511"}
    own["hall-2"] = "unity/2/767"
    for _ in range(2):
        waiting = []
        for name, address in own.items():
            kind, _, number = address.split("/")
            done = asyncio.Event()
            hears[name].subscribe(f"macs/to/{address}/{kind}/{number}", lambda batch, done=done: done.set())  # type: ignore[misc]
            waiting.append((says[name], f"macs/to/{address}/{kind}/{number}", done))
        for mesh, key, done in waiting:
            while not done.is_set():  # until the router knows of the subscription
                mesh.put_unasked(key, b"x")
                with suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(done.wait(), 0.2)


QUERIES = [
    # who asks, who answers, the key, whether there is an answer
    ("hall-1", "robot-7", "macs/call/ros/7/ask/unity/256", True),
    ("hall-1", "robot-7", "macs/call/ros/7/ask/unity/512", False),
    ("hall-1", "robot-7", "macs/call/ros/7/ask/operator/0", False),
    ("hall-2", "robot-7", "macs/call/ros/7/add_node/unity/512", True),
    ("hall-2", "robot-7", "macs/call/ros/7/ask/unity/512", False),
    ("hall-2", "robot-8", "macs/call/ros/8/add_node/unity/512", False),
    ("hall-1", "robot-9", "macs/call/ros/9/add_node/unity/256", False),
    ("anna", "robot-9", "macs/call/ros/9/status/operator/0", True),
    ("anna", "robot-9", "macs/call/ros/9/stop/operator/0", False),
    ("robot-8", "robot-7", "macs/ca/to/drone7/t/by/drone8", True),
    ("robot-8", "robot-7", "macs/ca/last/drone7/t/by/drone8", True),
    ("robot-9", "robot-7", "macs/ca/to/drone7/t/by/drone9", False),
    ("robot-9", "robot-7", "macs/ca/to/drone7/t/by/drone8", False),
    ("robot-9", "robot-7", "macs/ca/last/drone7/t/by/drone9", False),
    ("robot-8", "robot-7", "macs/call/ros/7/ask/ros/8", False),
    ("hall-1", "robot-8", "macs/call/ros/7/mine/unity/256", False),
]


async def test_queries_by_role(site: Site) -> None:
    """Between each pair of roles what may be asked is answered by whom it concerns, and nothing else is."""
    async with AsyncExitStack() as stack:
        meshes = {
            client.name: await stack.enter_async_context(site.session(client.name)) for client in site.policy.clients
        }

        async def answer(key: str, payload: bytes) -> bytes:
            return b"yes"

        for robot, own, name in (("robot-7", 7, "drone7"), ("robot-8", 8, "drone8"), ("robot-9", 9, "drone9")):
            for key in (f"macs/call/ros/{own}/**", f"macs/ca/to/{name}/**", f"macs/ca/last/{name}/**"):
                meshes[robot].serve(key, answer)
        meshes["robot-8"].serve("macs/call/ros/7/mine/**", answer)  # as a thief
        meshes["robot-7"].serve("macs/call/ros/7/ask/**", answer)
        for asker, _, key, permitted in QUERIES:
            if permitted:
                await until_answered(meshes[asker], key)
        for asker, _, key, permitted in QUERIES:
            if key.endswith("mine/unity/256"):
                continue
            patience_s = PATIENCE_S if permitted else 1.0
            assert await answered(meshes[asker], key, patience_s) == permitted, (asker, key)


async def test_nobody_answers_for_another(site: Site) -> None:
    """A call of robot 7 that only robot 8 serves has no answer."""
    async with site.session("robot-8") as thief, site.session("robot-7") as robot, site.session("hall-1") as hall:

        async def answer(key: str, payload: bytes) -> bytes:
            return b"yes"

        thief.serve("macs/call/ros/7/mine/**", answer)
        thief.serve("macs/call/ros/8/own/**", answer)
        robot.serve("macs/call/ros/7/own/**", answer)
        await until_answered(hall, "macs/call/ros/8/own/unity/256")  # declared after the stolen one
        await until_answered(hall, "macs/call/ros/7/own/unity/256")
        assert not await answered(hall, "macs/call/ros/7/mine/unity/256")


async def answered(mesh: Mesh, key: str, timeout_s: float = 1.0) -> bool:
    try:
        return await mesh.query(key, b"", timeout_s=timeout_s) == b"yes"
    except (Unreachable, NotServed, Refused):
        return False


async def until_answered(mesh: Mesh, key: str) -> None:
    async def ask() -> None:
        while not await answered(mesh, key):
            await asyncio.sleep(0.02)

    await asyncio.wait_for(ask(), PATIENCE_S)


TOKENS = [
    # who declares, the token, who sees it
    ("robot-7", "macs/live/ros/7/3/a1", {"robot-7", "robot-8", "hall-1", "hall-2", "anna"}),
    ("robot-7", "macs/live/ros/7/4/a1", set()),
    ("robot-7", "macs/live/ros/8/3/a1", set()),
    ("robot-7", "macs/live/unity/7/0/a1", set()),
    ("robot-9", "macs/live/ros/9/0/a1", {"robot-9", "anna"}),
    ("hall-1", "macs/live/unity/256/0/a1", {"robot-7", "robot-8", "hall-1", "hall-2", "anna"}),
    ("hall-1", "macs/live/unity/512/0/a1", set()),
    ("hall-1", "macs/live/ros/7/3/a2", set()),
    ("hall-1", "macs/block/1/a1", {"hall-1", "hall-2", "anna"}),
    ("hall-1", "macs/block/2/a1", set()),
    ("hall-2", "macs/live/unity/512/0/a2", {"robot-7", "hall-1", "hall-2", "anna"}),
    ("robot-7", "macs/name/drone7/ros/7/a1", {"robot-7", "robot-8", "anna"}),
    ("robot-7", "macs/name/drone8/ros/7/a1", set()),
    ("robot-8", "macs/ca/wanted/drone8/t/a1", {"robot-7", "robot-8", "anna"}),
    ("robot-9", "macs/ca/wanted/drone8/t/a2", set()),
    ("anna", "macs/live/ros/7/3/a3", set()),
    ("anna", "macs/block/1/a3", set()),
]


async def test_presence_by_role(site: Site) -> None:
    """Each is online as itself only, and seen by those who have to do with it, and by operators."""
    names = [client.name for client in site.policy.clients]
    async with AsyncExitStack() as stack:
        watches = {name: await stack.enter_async_context(site.session(name)) for name in names}
        declares = {name: await stack.enter_async_context(site.session(name)) for name in names}
        seen: dict[str, set[str]] = {key: set() for _, key, _ in TOKENS}
        spaces = ("macs/live/**", "macs/block/**", "macs/name/**", "macs/ca/wanted/**")

        def see(name: str) -> Callable[[str, bool], None]:
            return lambda key, alive: seen.setdefault(key, set()).add(name)

        watching = [mesh.watch_tokens(space, see(name)) for name, mesh in watches.items() for space in spaces]
        tokens = [declares[name].declare_token(key) for name, key, _ in TOKENS]
        await settled(site, watches, declares)
        await until(lambda: all(who <= seen[key] for _, key, who in TOKENS))
        for name, key, who in TOKENS:
            assert seen[key] == who, (name, key)
            found: set[str] = set()
            while (
                not found >= who
            ):  # a router tells subscribers of a token a moment before it answers questions for it
                answers = {watcher: await watches[watcher].tokens(key, timeout_s=PATIENCE_S) for watcher in names}
                found = {watcher for watcher, answer in answers.items() if answer}
            assert found == who, (name, key)
        for declared in tokens + watching:
            declared.close()


async def test_wildcards_get_round_nothing(site: Site) -> None:
    """Putting to several keys at once, or subscribing to more than is one's own, reaches nobody and hears nothing."""
    async with AsyncExitStack() as stack:
        names = [client.name for client in site.policy.clients]
        hears = {name: await stack.enter_async_context(site.session(name)) for name in names}
        says = {name: await stack.enter_async_context(site.session(name)) for name in names}
        robot = listening(hears["robot-9"], "macs/to/ros/0/9/**")
        thief = [listening(hears["hall-2"], key) for key in ("macs/**", "macs/to/**", "macs/to/ros/*/*/unity/*")]
        await settled(site, hears, says)
        for key in ("macs/to/ros/*/*/unity/256", "macs/to/ros/**", "macs/**/unity/256", "macs/to/ros/0/*/unity/256"):
            says["hall-1"].put_unasked(key, b"x")
        says["hall-1"].put_unasked("macs/to/ros/0/7/unity/256", b"x")
        await settled(site, hears, says)
        assert not [key for key, _ in robot if "unity" in key]
        assert {key for got in thief for key, _ in got} <= {"macs/to/unity/2/767/unity/767"}


# -- stolen, foreign, expired ----------------------------------------------------------------------------------------


async def test_a_stolen_gateway_certificate_is_no_robot(site: Site) -> None:
    """With a gateway's certificate nobody is online as a robot, publishes its topics, answers for it or takes its
    messages; nor is he another gateway's headset."""
    stolen = site.settings("hall-1")
    async with (
        macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")) as robot,
        macs_zenoh.join("unity", id=513, settings=site.settings("hall-2")) as headset,
        macs_zenoh.join("unity", id=256, settings=stolen) as real,
    ):
        await until(lambda: ("ros", 7) in online(headset) and ("unity", 256) in online(robot))

        async def answer(call: macs_zenoh.Call) -> bytes:
            return b"the robot"

        robot.serve("add_node", answer)
        stream = listening(headset.mesh, STREAM.every(type="ros", id=7))
        while True:
            with suppress(Unreachable):
                await headset.call("ros", 7, "add_node")
                break
        async with (
            macs_zenoh.join("ros", id=70, group=3, settings=stolen) as thief,
            macs_zenoh.join("unity", id=514, settings=stolen) as other,
        ):
            thief.serve("add_node", answer)
            forged = thief.mesh.declare_token("macs/live/ros/7/3/a1")
            inbox = listening(thief.mesh, "macs/to/ros/0/7/**")
            thief.mesh.put_unasked("macs/from/ros/7/nd__x", b"forged")
            thief.mesh.put_unasked("macs/to/unity/2/513/ros/7", b"forged")
            other.mesh.put_unasked("macs/to/unity/2/513/unity/514", b"forged")
            real.send(b"command", to="ros", ids=[7])
            assert (await asyncio.wait_for(robot.receive(), PATIENCE_S)).data == b"command"
            Streams(robot).publish("nd__x", b"true")
            robot.send(b"true", to="unity", ids=[513])
            assert (await asyncio.wait_for(headset.receive(), PATIENCE_S)).data == b"true"
            await until(lambda: stream)
            assert stream == [("macs/from/ros/7/nd__x", b"true")]
            assert not inbox
            for agent in (robot, headset, real):
                assert ("ros", 70) not in online(agent)
                assert ("unity", 514) not in online(agent)
            assert [a.zid for a in headset.online() if a.type == 1] == [robot.mesh.zid]
            forged.close()


def online(agent: macs_zenoh.Agent) -> set[tuple[str, int]]:
    return {(one.type_name, one.id) for one in agent.online()}


async def test_who_is_not_of_this_mesh_is_not_let_in(site: Site, tmp_path: Path) -> None:
    """A certificate that has expired, that another authority made, or none at all, gets no session; nor does TCP."""
    past = NOW - dt.timedelta(days=200)
    authority, _ = certificates.authority(site.directory, site.policy, NOW)
    authority.issue(tmp_path / "expired" / "robot-7", None, site.policy, past, renew=False)
    generate(site.policy, tmp_path / "foreign", NOW)
    ours = site.directory / "robot-7" / "ca.pem"
    (tmp_path / "foreign" / "robot-7" / "ca.pem").write_bytes(ours.read_bytes())
    endpoint = site.router("site")[0]
    root = f"transport/link/tls/root_ca_certificate:'{ours}'"
    for overrides in (
        client_overrides(str(tmp_path / "expired" / "robot-7")),
        client_overrides(str(tmp_path / "foreign" / "robot-7")),
        [root],
    ):
        with pytest.raises(Unreachable):
            await Mesh.open_once(MeshSettings(connect=[endpoint], overrides=overrides), timeout_s=2)
    with pytest.raises(Unreachable):
        await Mesh.open_once(MeshSettings(connect=[endpoint.replace("tls/", "tcp/")]), timeout_s=2)
    async with site.session("robot-7") as mesh:  # and who is, is
        await until(lambda: mesh.routers)


async def test_a_client_is_no_router(site: Site) -> None:
    """A gateway's certificate does not make a router: who dials it there is not connected."""
    port = free_port()
    fake = MeshSettings(
        mode="router",
        listen=[f"tls/127.0.0.1:{port}"],
        overrides=[
            f"transport/link/tls/listen_private_key:'{site.directory}/hall-1/key.pem'",
            f"transport/link/tls/listen_certificate:'{site.directory}/hall-1/cert.pem'",
        ],
    )
    async with await Mesh.open(fake):
        victim = changed(site.settings("robot-7"), connect=[f"tls/127.0.0.1:{port}"])
        with pytest.raises(Unreachable):
            await Mesh.open_once(victim, timeout_s=3)


async def test_a_client_that_says_it_is_a_router_may_no_more(site: Site) -> None:
    """A client's certificate opens a session as a router as well, which Zenoh cannot refuse; what it may put, hear and
    declare there is the same."""
    stolen = changed(site.settings("robot-8"), mode="router", listen=[f"tcp/127.0.0.1:{free_port()}"])
    async with (
        site.session("robot-7") as robot,
        site.session("hall-2") as hall,
        site.session("anna") as anna,
        await Mesh.open(stolen) as thief,
    ):
        by_name = listening(robot, "macs/ca/to/drone7/**")
        inbox = listening(hall, "macs/to/unity/2/**")
        stream = listening(hall, "macs/from/ros/7/**")
        taken = [listening(thief, key) for key in ("macs/to/ros/0/7/**", "macs/from/**", "macs/ca/to/drone7/**")]
        tokens = [thief.declare_token(f"macs/live/ros/{number}/3/a8") for number in (7, 8)]
        while not by_name:  # what it may do
            thief.put_unasked("macs/to/unity/2/767/ros/7", b"forged")
            thief.put_unasked("macs/from/ros/7/nd__x", b"forged")
            thief.put_unasked("macs/ca/to/drone7/t/by/drone8", b"x")
            await asyncio.sleep(0.05)
        while not (stream and inbox):
            robot.put_unasked("macs/from/ros/7/nd__x", b"true")
            robot.put_unasked("macs/to/unity/2/767/ros/7", b"true")
            await asyncio.sleep(0.05)
        assert {bytes(payload) for _, payload in (*stream, *inbox)} == {b"true"}
        assert {bytes(payload) for got in taken for _, payload in got} == {b"forged", b"x"}  # its own
        assert await anna.tokens("macs/live/**", timeout_s=PATIENCE_S) == ["macs/live/ros/8/3/a8"]
        for token in tokens:
            token.close()


async def test_a_link_ends_with_its_certificate(site: Site) -> None:
    """A session whose certificate expires is cut off, and is back with a renewed one without being started again."""
    short = policy.parse(
        "routers: [{name: site, addresses: [127.0.0.1]}]\nrobots: [{name: robot-7, id: 7}]\ncertificates: {days: 1}\n"
    )
    authority, _ = certificates.authority(site.directory, site.policy, NOW)
    ends_in = dt.timedelta(seconds=4)
    soon = dt.datetime.now(dt.timezone.utc) - dt.timedelta(days=1) + ends_in
    authority.issue(site.directory / "robot-7", None, short, soon, renew=True)
    async with site.session("robot-7") as mesh:
        await until(lambda: not mesh.linked)
        authority.issue(site.directory / "robot-7", None, site.policy, NOW, renew=True)
        await until(lambda: mesh.linked)


async def test_who_left_the_plan_may_nothing(tmp_path: Path) -> None:
    """After the policy lost a robot and the router has its new file, the old certificate is good for nothing; another
    robot has its id."""
    found = made(tmp_path / "pki")
    text = CLIENTS.replace("robot-7, id", "robot-7b, id").replace("whom: robot-7}", "whom: robot-7b}")
    listen = f"routers: [{{name: site, addresses: [127.0.0.1], listen: ['{found.router('site')[0]}']}}]"
    without = policy.parse(
        listen + text.replace("[robot-7, robot-8]", "[robot-7b, robot-8]").replace("who: robot-7,", "who: robot-7b,")
    )
    report = generate(without, found.directory, NOW)
    assert [name for name, _ in report.orphaned] == ["robot-7"]
    after = Site(without, found.directory)
    async with Router(after.file()), after.session("robot-7") as thief, after.session("anna") as anna:
        heard = [listening(thief, key) for key in ("macs/to/ros/0/7/**", "macs/all/**")]
        token = thief.declare_token("macs/live/ros/7/3/a1")
        async with (
            macs_zenoh.join("ros", id=7, group=3, settings=after.settings("robot-7b")) as robot,
            macs_zenoh.join("unity", id=256, settings=after.settings("hall-1")) as headset,
        ):
            await until(lambda: ("ros", 7) in online(headset))
            thief.put_unasked("macs/to/unity/1/256/ros/7", b"forged")
            assert await thief.tokens("macs/live/**") == ["macs/live/ros/7/3/a1"]  # its own session knows that
            headset.send(b"command", to="ros", ids=[7])
            headset.broadcast(b"to all")
            assert [(await asyncio.wait_for(robot.receive(), PATIENCE_S)).data for _ in range(2)] == [
                b"command",
                b"to all",
            ]
            robot.send(b"back", to="unity", ids=[256])
            assert (await asyncio.wait_for(headset.receive(), PATIENCE_S)).data == b"back"
            assert heard == [[], []]
            assert "macs/live/ros/7/3/a1" not in await anna.tokens("macs/live/**")
        token.close()


# -- the check -------------------------------------------------------------------------------------------------------


async def test_a_generated_router_holds_everybody_to_the_plan(site: Site) -> None:
    """Tried with every certificate on the real router: everything is as expected, permitted and forbidden alike."""
    results = await check(site.policy, site.directory)
    assert [result for result in results if not result.as_expected] == []
    for word in ("heard by", "is online", "calls", "delivers to"):
        assert {result.permitted for result in results if word in result.what} == {True, False}, word


async def test_the_same_through_our_own_router(tmp_path: Path) -> None:
    """`macs router -c` with the generated file does the same as zenohd."""
    found = made(tmp_path / "pki")
    async with Program("router", "-c", str(found.file())):
        assert await found.wrong() == []


async def test_across_two_routers(tmp_path: Path) -> None:
    """What is permitted passes the link between two routers, both ways, and what is forbidden does not."""
    found = made(tmp_path / "pki", routers=2)
    async with Router(found.file("site")), Router(found.file("cloud")):
        await linked(found)
        results = await check(found.policy, found.directory)
    assert {result.router for result in results} == {"site", "cloud", "site to cloud", "cloud to site"}
    assert [result for result in results if not result.as_expected] == []


async def linked(found: Site) -> None:
    """Wait until a robot on one router and a gateway on the other see each other."""
    async with found.session("robot-7", "site") as robot, found.session("hall-1", "cloud") as hall:
        token = robot.declare_token("macs/live/ros/7/3/a1")
        while not await hall.tokens("macs/live/**"):
            await asyncio.sleep(0.05)
        token.close()


async def test_gateways_without_blocks_and_a_namespace(tmp_path: Path) -> None:
    """The shortest policy, within a namespace, is held to as well."""
    found = made(
        tmp_path / "pki",
        "\nrobots: [{name: r, id: 7, awareness_name: drone7}, {name: s, id: 300, awareness_name: drone8}]\n"
        "gateways: [{name: hall}, {name: lab}]\noperators: [{name: anna}, {name: berta, id: 5}]\n"
        "permissions: [{who: all, may: all, whom: all}]\nnamespace: site1\n",
    )
    async with Router(found.file()):
        assert await found.wrong() == []


LOOSENED = {
    "a gateway commands a robot": ("hall-2 speaks", "macs/to/ros/0/7/unity/767", "hall-2 puts to robot-7 by id"),
    "a gateway is another's headset": ("hall-2 speaks", "macs/**/unity/*", "hall-2 puts as hall-1"),
    "a robot calls": ("robot-7 asks", "macs/call/**", "robot-7 calls macs_check of robot-8"),
    "a robot is another": ("robot-9 is present", "macs/live/**", "robot-9 is online as robot-7"),
    "a robot sees all": ("robot-9 sees who is there", "macs/live/**", "robot-7 is online, heard by robot-9"),
    "a gateway leases all": ("hall-2 is present", "macs/block/*/*", "hall-2 leases block 1 as hall-1"),
    "an operator sees a stream": ("anna", "macs/from/**", "robot-7 puts on a stream, heard by anna"),
    "a robot reads another's mail": ("robot-9", "macs/ca/to/**", "robot-7 puts to robot-8 by name, heard by somebody"),
    "a gateway answers for a robot": ("hall-2 answers", "macs/call/**", "hall-2 answers hall-1 as robot-7"),
}


@pytest.mark.parametrize("how", LOOSENED)
async def test_the_check_finds_a_rule_that_was_loosened(how: str, tmp_path: Path) -> None:
    """Whatever somebody added to a router's rules by hand is found, with what it lets through."""
    rule, key, found_as = LOOSENED[how]
    found = made(tmp_path / "pki")
    names = [rule] if " " in rule else [f"{rule} subscribes", f"{rule} hears"]
    if rule.endswith(" answers"):
        names.append(rule.replace("answers", "is asked"))
    text = found.file().read_text()
    for name in names:
        text = with_key(text, name, key)
    found.file().write_text(text)
    async with Router(found.file()):
        wrong = await found.wrong()
    assert any(one.what.startswith(found_as) and one.seen and not one.permitted for one in wrong), wrong


def with_key(text: str, rule: str, key: str) -> str:
    head, mark, tail = text.partition(f'id: "{rule}",')
    assert mark, rule
    before, keys, after = tail.partition("key_exprs: [")
    return f'{head}{mark}{before}{keys}"{key}", {after}'


@pytest.mark.parametrize(
    ("rule", "found_as"),
    [
        ("robot-7 hears", "hall-1 puts to robot-7 by id, heard by robot-7"),
        ("hall-1 asks", "hall-1 calls macs_check of robot-7"),
        ("robot-8 is present", "robot-8 is online, heard by hall-1"),
        ("anna is answered", "anna asks who the routers are"),
    ],
)
async def test_the_check_finds_a_rule_that_is_missing(rule: str, found_as: str, tmp_path: Path) -> None:
    """A rule that is not there any more is found by what does not work without it."""
    found = made(tmp_path / "pki")
    text = found.file().read_text()
    assert text.count(f'"{rule}"') == 2
    policy = text.rindex(f'"{rule}"')
    found.file().write_text(text[:policy] + text[policy:].replace(f'"{rule}", ', "", 1).replace(f'"{rule}",', "", 1))
    async with Router(found.file()):
        wrong = await found.wrong()
    assert any(one.what.startswith(found_as) and one.permitted and not one.seen for one in wrong), wrong


async def test_the_check_finds_a_router_that_lets_everybody_in(tmp_path: Path) -> None:
    """Without mutual TLS, or with rules that allow by default, almost everything is wrong, and it says so."""
    found = made(tmp_path / "pki")
    text = found.file().read_text()
    found.file().write_text(
        text.replace('default_permission: "deny"', 'default_permission: "allow"').replace(
            "enable_mtls: true", "enable_mtls: false"
        )
    )
    async with Router(found.file()):
        wrong = {one.what for one in await found.wrong()}
    assert "somebody without a certificate is let in" in wrong
    assert "robot-9 is online as robot-7, heard by hall-1" in wrong


async def test_a_check_does_not_disturb_who_is_there(site: Site) -> None:
    """While everything is tried, agents get no message and no call, see nobody come or go, and go on working."""
    async with (
        macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")) as robot,
        macs_zenoh.join("unity", id=511, group=3, settings=site.settings("hall-1")) as headset,
        awareness.join(robot, "drone7") as drone,
    ):
        await until(lambda: ("ros", 7) in online(headset))
        changes: list[object] = []
        called: list[str] = []

        async def answer(call: macs_zenoh.Call) -> bytes:
            called.append(call.verb)
            return b""

        for verb in ("status", "stop", "add_node"):
            robot.serve(verb, answer)
        for agent in (robot, headset):
            agent.on_presence(lambda who, here: changes.append((who, here)))
        known = len(changes)
        assert await site.wrong() == []
        headset.send(b"after", to="ros", ids=[7])
        robot.send(b"after", to="unity", ids=[511])
        for agent in (robot, headset):
            assert (await asyncio.wait_for(agent.receive(), PATIENCE_S)).data == b"after"
            assert not agent.drops
        assert len(changes) == known
        assert not called
        assert drone.others() == []


async def test_calls_of_others_pass_a_check(site: Site) -> None:
    """While everything is tried, a call of a robot that is online gets that robot's answer, and one of a robot that is
    not gets none."""
    async with (
        macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")) as robot,
        macs_zenoh.join("unity", id=256, settings=site.settings("hall-1")) as headset,
    ):

        async def answer(call: macs_zenoh.Call) -> bytes:
            return call.data + b" by the robot"

        verbs = ("stop", "add_node", "status")
        for verb in verbs:
            robot.serve(verb, answer)
        await until(lambda: ("ros", 7) in online(headset))
        checking = asyncio.create_task(site.wrong())
        calls = 0
        while not checking.done():
            for verb in verbs:
                assert await headset.call("ros", 7, verb, b"%d" % calls) == b"%d by the robot" % calls
                with pytest.raises(Unreachable):
                    await headset.call("ros", 8, verb)
                calls += 1
        assert await checking == []
        assert calls > len(verbs)


async def test_a_stand_in_gives_way(site: Site) -> None:
    """Who stands in for a robot is asked while the robot is not there, and not any more when it is; its silence is no
    answer."""
    asked: list[bytes] = []

    async def silence(key: str, payload: bytes) -> bytes | None:
        asked.append(payload)
        return None

    async def answer(key: str, payload: bytes) -> bytes:
        return b"yes"

    key = "macs/call/ros/7/stop/unity/256"
    async with site.session("robot-7") as first, site.session("robot-7") as robot, site.session("hall-1") as hall:
        first.serve("macs/call/ros/7/stop/**", silence, stand_in=True)
        while not asked:
            assert not await answered(hall, key)
        robot.serve("macs/call/ros/7/**", answer)
        await until_answered(hall, key)
        asked.clear()
        assert [await answered(hall, key, PATIENCE_S) for _ in range(10)] == [True] * 10
        assert not asked


# -- our programs ----------------------------------------------------------------------------------------------------


async def test_our_programs_work_with_the_generated_files(site: Site) -> None:
    """A gateway process, a headset on it and robots, each with its own file: topics, commands and names."""

    @asynccontextmanager
    async def robot_of(name: str, number: int, group: int) -> AsyncIterator[macs_zenoh.Agent]:
        async with macs_zenoh.join("ros", id=number, group=group, settings=site.settings(name)) as agent:

            async def add(call: macs_zenoh.Call) -> bytes:
                return b""

            agent.serve("add_node", add)
            yield agent

    async with (
        Program("gateway", "--settings", str(site.directory / "hall-1" / "macs.toml"), "--port", "0") as gateway,
        robot_of("robot-7", 7, 3) as robot,
        robot_of("robot-8", 8, 3) as other,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
        awareness.join(robot, "drone7") as drone,
        awareness.join(other, "drone8") as second,
    ):
        assert headset.id // 256 == 1
        while {7, 8} - set((await headset.online()).ros_agent_ids):
            await asyncio.sleep(0.02)
        await headset.send(b"command", to=1, ids=[7])
        await headset.send(b"to the group", to=1, groups=[3])
        assert [(await asyncio.wait_for(robot.receive(), PATIENCE_S)).data for _ in range(2)] == [
            b"command",
            b"to the group",
        ]
        assert (await asyncio.wait_for(other.receive(), PATIENCE_S)).data == b"to the group"

        topic = await headset.subscribe("/pose", "std_msgs/String", agents=[7])
        metadata = Metadata(1, 7, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__pose", "std_msgs/String")
        management = encode_management(StreamData({"2": [headset.id]}))
        frame = encode_frame(1, management=management, message=encode_message(metadata.encode(), b"topic data"))
        while True:
            Streams(robot).publish("nd__pose", frame)  # until it knows of the subscription
            with suppress(asyncio.TimeoutError):
                message = await asyncio.wait_for(topic.__anext__(), 0.1)
                break
        assert bytes(message.data) == b"topic data"

        received: asyncio.Queue[awareness.Received] = asyncio.Queue()
        second.register("planning", received.put_nowait)
        await drone.wait_for("drone8", "planning", timeout_s=PATIENCE_S)
        assert await drone.deliver("drone8", "planning", b"by name", deadline_s=PATIENCE_S) is Outcome.DELIVERED
        assert (await asyncio.wait_for(received.get(), PATIENCE_S)).data == b"by name"


async def test_what_was_missed_is_asked_for(tmp_path: Path) -> None:
    """A gateway gets what it missed of a reliable topic, and a robot of a reliable message type, through a restart of
    the router."""
    found = made(tmp_path / "pki")
    rules = [config.TrafficRule(match="**", cache=5000)]
    keys = ("macs/from/ros/7/nd__log", "macs/ca/all/planning/by/drone7")
    router = Router(found.file())
    async with (
        router,
        await Mesh.open(found.settings("robot-7"), traffic=rules) as source,
        await Mesh.open(found.settings("hall-1")) as hall,
        await Mesh.open(found.settings("robot-8")) as robot,
        Stream(source, *keys) as stream,
    ):
        topic, messages = Numbers(), Numbers()
        hall.subscribe(keys[0], topic.take, reliable=True, on_miss=topic.miss)
        robot.subscribe("macs/ca/all/planning/by/**", messages.take, reliable=True, on_miss=messages.miss)
        await until(lambda: topic.heard and messages.heard)
        await router.stop(signal.SIGKILL)
        before = stream.sent
        await until(lambda: stream.sent > before + 20)
        await router.start()
        back = stream.sent
        for got in (topic, messages):
            await until(lambda got=got: got.heard[-1] >= back)  # type: ignore[misc]
            assert got.heard == list(range(got.heard[0], got.heard[-1] + 1))
            assert not got.missed


async def test_an_operator_looks(site: Site) -> None:
    """`macs ls` with an operator's settings sees everybody."""
    async with (
        macs_zenoh.join("ros", id=9, settings=site.settings("robot-9")),
        macs_zenoh.join("unity", id=256, settings=site.settings("hall-1")),
    ):
        rows = await macs("ls", "--json", "--settings", str(site.directory / "anna" / "macs.toml"))
        assert {(row["type"], row["id"]) for row in rows} == {("ros", 9), ("unity", 256)}


async def test_an_operator_stops_with_its_own_file(tmp_path: Path) -> None:
    """The generated settings say who an operator is, so that it stops robots and asks them without --as; who asks as
    somebody else is told that rules may be why nobody answers."""
    clients = CLIENTS.replace("{name: anna}", "{name: anna, id: 5}")
    site = made(tmp_path / "pki", clients.replace("may: call, verbs: [status]", "may: [command, call]"))
    settings = ("--settings", str(site.directory / "anna" / "macs.toml"))
    callers: list[str] = []

    async def answer(call: macs_zenoh.Call) -> bytes:
        callers.append(f"{call.verb} by {call.sender_type}/{call.sender_id}")
        return b'{"ros_node": "/r", "stopped": true, "stop": {"by": "operator/5"}, "nodes": []}'

    async with (
        Router(site.file()),
        macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")) as robot,
    ):
        for verb in ("status", "stop"):
            robot.serve(verb, answer)
        while not (await macs("ls", "--json", *settings))[0]["status"]:  # until the router knows what it serves
            await asyncio.sleep(0.02)
        assert set(callers) == {"status by operator/5"}
        code, out, _ = await ended("stop", *settings)
        assert (code, out) == (0, "robot 7 is stopped, by operator/5\n")
        code, out, _ = await ended("doctor", "--quick", *settings)
        assert (code, "operator/5" in out) == (0, True), out

        denied = "it does not answer operator/0; access rules may not allow it (--as operator/N)"
        nobody = (*settings, "--as", "operator/0")
        code, out, _ = await ended("stop", "--timeout", "1", *nobody)
        assert (code, out) == (1, f"robot 7 is NOT stopped: {denied}\n")
        assert (await macs("ls", "--json", *nobody))[0]["problem"] == denied
        code, out, _ = await ended("ls", *nobody)
        assert out.splitlines()[1].endswith("?")
        code, out, _ = await ended("ls", "-v", *nobody)
        assert f"tells nothing: {denied}" in out


@pytest.mark.parametrize("verbs", ["status", "status, ping"])
async def test_an_operator_who_may_not_stop_hears_which_right_is_missing(tmp_path: Path, verbs: str) -> None:
    """A robot that tells its state has an emergency stop; that this operator may not use it is said."""
    site = made(tmp_path / "pki", CLIENTS.replace("[status]", f"[{verbs}]"))

    async def answer(call: macs_zenoh.Call) -> bytes:
        return b'{"ros_node": "/r", "stopped": true, "stop": {"by": "operator/0"}, "nodes": []}'

    async with (
        Router(site.file()),
        macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")) as robot,
    ):
        for verb in ("status", "stop"):
            robot.serve(verb, answer)
        settings = ("--settings", str(site.directory / "anna" / "macs.toml"))
        while not (await macs("ls", "--json", *settings))[0]["status"]:
            await asyncio.sleep(0.02)
        code, out, _ = await ended("stop", "--timeout", "3", *settings)
        assert (code, out.partition(";")[0]) == (
            1,
            "robot 7 is NOT stopped: access rules do not let operator/0 call its verb stop",
        )
        assert "a policy gives it by `may: call` with `verbs: [stop]`" in out


def test_the_shipped_wan_plan_has_an_operator_who_may_stop() -> None:
    """Somebody who looks at robots from wherever can stop them, and can do no more to them."""
    wan = policy.load(ROOT / "config" / "wan" / "policy.yaml")
    (anna,) = wan.operators
    for robot in wan.robots:
        verbs = wan.verbs(anna, robot)
        assert verbs is not None
        assert {"status", "stop"} <= set(verbs)
        assert not wan.may(anna, "command", robot)


@pytest.mark.parametrize(
    ("file", "content", "problem"),
    [
        ("ca.pem", None, "No such file or directory"),
        ("key.pem", b"garbage", "there is no private key in this file"),
        ("cert.pem", b"", "there is no certificate in this file"),
    ],
)
async def test_a_file_that_cannot_be_used_is_named(
    file: str, content: bytes | None, problem: str, tmp_path: Path
) -> None:
    """Programs end at once, and name the setting and the file."""
    site = made(tmp_path / "pki")
    for name in ("hall-1", "site"):
        path = site.directory / name / file
        path.unlink()
        if content is not None:
            path.write_bytes(content)
    settings = ("--settings", str(site.directory / "hall-1" / "macs.toml"))
    for verb in ("gateway", "ls"):
        code, _, errors = await ended(verb, *settings)
        assert code == 2, errors
        assert f"{site.directory / 'hall-1' / file}: {problem}" in errors
        assert "transport/link/tls/" in errors
    code, _, errors = await ended("router", "-c", str(site.file()))
    assert code == 2, errors
    assert f"{path}: {problem}" in errors


async def test_a_gateway_keeps_to_its_blocks(site: Site) -> None:
    """A second gateway with the same certificate finds no block that it may have."""
    settings = str(site.directory / "hall-1" / "macs.toml")
    async with Program("gateway", "--settings", settings, "--port", "0"):
        loaded = load(settings)
        async with await Mesh.open_once(loaded.mesh, timeout_s=10) as mesh:
            second = Gateway(mesh, changed(loaded.gateway, port=0))
            try:
                with pytest.raises(Unreachable, match="all that this gateway may have"):
                    await second.start()
            finally:
                await second.close()


# -- the command -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
async def test_a_check_that_was_stopped_is_none_that_went_well(how: signal.Signals, tmp_path: Path) -> None:
    """Ctrl-C or SIGTERM in the middle of a check ends it with 130."""
    found = made(tmp_path / "pki")
    listen = found.router("site")[0]
    (tmp_path / "policy.yaml").write_text(
        f"routers: [{{name: site, addresses: [127.0.0.1], listen: ['{listen}']}}]" + CLIENTS
    )
    with socket.create_server(("127.0.0.1", int(listen.rpartition(":")[2]))) as says_nothing:
        says_nothing.setblocking(False)
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "bridge", "security", "check", str(tmp_path / "policy.yaml")),
            *("--dir", str(found.directory)),
            cwd=ROOT,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
        )
        begun, _ = await asyncio.wait_for(asyncio.get_running_loop().sock_accept(says_nothing), PATIENCE_S)
        process.send_signal(how)
        assert await asyncio.wait_for(process.wait(), PATIENCE_S) == 130
        begun.close()


async def test_a_check_without_a_router_gives_up(tmp_path: Path) -> None:
    """Where nobody listens, a check ends after its time with one line, however many sessions it would have made."""
    found = made(tmp_path / "pki")
    nowhere = found.router("site")[0]
    plan_file = tmp_path / "policy.yaml"
    plan_file.write_text(f"routers: [{{name: site, addresses: [127.0.0.1], listen: ['{nowhere}']}}]" + CLIENTS)
    began = time.monotonic()
    code, out, errors = await ended(
        "security", "check", str(plan_file), "--dir", str(found.directory), "-e", nowhere, "--timeout", "1"
    )
    assert time.monotonic() - began < 10, "1 s, and the start of a program on a busy machine"
    assert (code, out) == (1, "")
    assert errors == f"macs security: {nowhere} cannot be reached: nobody listens there, tried for 1 s\n"


async def test_the_command_generates_and_checks(tmp_path: Path) -> None:
    """`macs security generate` says what it made, `check` whether it holds; the exit code says it to programs."""
    found = made(tmp_path / "unused")
    routers = f"routers: [{{name: site, addresses: [127.0.0.1], listen: ['{found.router('site')[0]}']}}]"
    (tmp_path / "policy.yaml").write_text(routers + CLIENTS)
    pki = str(tmp_path / "pki")
    code, out, _ = await ended("security", "generate", str(tmp_path / "policy.yaml"), "--into", pki)
    assert code == 0
    assert "7 certificates made, 0 kept, 7 files written" in out
    told = await macs(
        "security", "generate", str(tmp_path / "policy.yaml"), "--into", pki, "--renew", "anna", "--json"
    )
    assert [one["name"] for one in told["certificates"] if one["made"]] == ["anna"]
    assert (told["written"], told["restart"]) == ([], [])

    code, out, errors = await ended("security", "check", str(tmp_path / "policy.yaml"), "--dir", pki)
    assert (code, out) == (1, "")
    assert "nobody listens there" in errors
    async with Router(tmp_path / "pki" / "site" / "router.json5"):
        code, out, _ = await ended("security", "check", str(tmp_path / "policy.yaml"), "--dir", pki)
        assert code == 0, out
        assert out.endswith(" 0 not\n")
        results = await macs("security", "check", str(tmp_path / "policy.yaml"), "--dir", pki, "--json")
        assert all(result["as_expected"] for result in results)
    (tmp_path / "policy.yaml").write_text(routers + CLIENTS.replace("robot-7, id", "robot-7, idd"))
    code, _, errors = await ended("security", "generate", str(tmp_path / "policy.yaml"), "--into", pki)
    assert code == 2
    assert "did you mean `id`?" in errors
