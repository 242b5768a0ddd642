"""A policy on real routers with mutual TLS: who gets in, and who may what."""

from __future__ import annotations

import asyncio
import datetime as dt
from collections.abc import Callable
from contextlib import AsyncExitStack, suppress
from pathlib import Path

import pytest

import macs_zenoh
from bridge.security import certificates, policy
from bridge.security.files import client_overrides
from bridge.security.generate import generate
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import Unreachable
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.sections import changed
from macs_zenoh.streams import Streams
from tests.support.programs import free_port
from tests.support.routers import Router
from tests.support.secured import CLIENTS, NOW, Site, answered, listening, made, online, until_answered
from tests.support.waiting import PATIENCE_S, until

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


TOKENS = [
    # who declares, the token, who sees it
    ("robot-7", "macs/live/ros/0/7/3/a1", {"robot-7", "robot-8", "hall-1", "hall-2", "anna"}),
    ("robot-7", "macs/live/ros/0/7/4/a1", set()),
    ("robot-7", "macs/live/ros/0/8/3/a1", set()),
    ("robot-7", "macs/live/unity/0/7/0/a1", set()),
    ("robot-9", "macs/live/ros/0/9/0/a1", {"robot-9", "anna"}),
    ("hall-1", "macs/live/unity/1/256/0/a1", {"robot-7", "robot-8", "hall-1", "hall-2", "anna"}),
    ("hall-1", "macs/live/unity/2/512/0/a1", set()),
    ("hall-1", "macs/live/ros/0/7/3/a2", set()),
    ("hall-1", "macs/block/1/a1", {"hall-1", "hall-2", "anna"}),
    ("hall-1", "macs/block/2/a1", set()),
    ("hall-2", "macs/live/unity/2/512/0/a2", {"robot-7", "hall-1", "hall-2", "anna"}),
    ("robot-7", "macs/name/drone7/ros/7/a1", {"robot-7", "robot-8", "anna"}),
    ("robot-7", "macs/name/drone8/ros/7/a1", set()),
    ("robot-8", "macs/ca/wanted/drone8/t/a1", {"robot-7", "robot-8", "anna"}),
    ("robot-9", "macs/ca/wanted/drone8/t/a2", set()),
    ("anna", "macs/live/ros/0/7/3/a3", set()),
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
            forged = thief.mesh.declare_token("macs/live/ros/0/7/3/a1")
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
        tokens = [thief.declare_token(f"macs/live/ros/0/{number}/3/a8") for number in (7, 8)]
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
        assert await anna.tokens("macs/live/**", timeout_s=PATIENCE_S) == ["macs/live/ros/0/8/3/a8"]
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
        token = thief.declare_token("macs/live/ros/0/7/3/a1")
        async with (
            macs_zenoh.join("ros", id=7, group=3, settings=after.settings("robot-7b")) as robot,
            macs_zenoh.join("unity", id=256, settings=after.settings("hall-1")) as headset,
        ):
            await until(lambda: ("ros", 7) in online(headset))
            thief.put_unasked("macs/to/unity/1/256/ros/7", b"forged")
            assert set(await thief.tokens("macs/live/**")) <= {"macs/live/ros/0/7/3/a1"}  # its own session knows that
            headset.send(b"command", to="ros", ids=[7])
            headset.broadcast(b"to all")
            assert [(await asyncio.wait_for(robot.receive(), PATIENCE_S)).data for _ in range(2)] == [
                b"command",
                b"to all",
            ]
            robot.send(b"back", to="unity", ids=[256])
            assert (await asyncio.wait_for(headset.receive(), PATIENCE_S)).data == b"back"
            assert heard == [[], []]
            assert "macs/live/ros/0/7/3/a1" not in await anna.tokens("macs/live/**")
        token.close()
