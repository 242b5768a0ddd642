"""Two sites with a router each, the link between them cut and back: each works by itself, and together they are one
mesh without duplicate ids."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import time
from collections import Counter
from collections.abc import AsyncIterator, Iterable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import pytest

import macs_zenoh
from bridge.gateway import Gateway, renumbering
from bridge.gateway.leases import Leases
from bridge.headset.client import Headset
from bridge.headset.nodes import Incoming, Subscription
from bridge.settings import GatewaySettings
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings, TrafficRule
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.existing import CDR
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AddNode,
    AgentsGone,
    Configuration,
    GoneAgent,
    Metadata,
    NodeType,
    RemoveNode,
    StreamData,
    Welcome,
    decode_data,
    encode_management,
)
from macs_zenoh.protocol.registrations import AgentKey, Task
from macs_zenoh.protocol.wire import Layout, encode_frame, encode_message, split_message
from macs_zenoh.registration_calls import RobotCalls
from macs_zenoh.sections import changed
from macs_zenoh.streams import Streams
from tests.support.links import Link, counted
from tests.support.programs import Program, macs
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

RIGHT_S = 3.0
"""How soon after the merge everything must be right."""

SOON = "connect/retry:{period_init_ms:500,period_max_ms:500,period_increase_factor:1}"
"""A router that lost the other one tries again at once, and then so often."""
FORGOTTEN_S = 0.25
"""Zenoh 1.10.2 works out its routes at most every 100 ms. A link that is lost and back in between is taken for one
that was never lost: nothing is declared on it, until it is lost again (docs/doctor.md)."""


WATCHERS = [(9, 60001), (9, 60002)]
"""Agents at the two sites that see what is online; gateways give out no id that an agent of any type has."""


class Sites:
    """Two routers, ``a`` and ``b``, and the link between them. Whatever is started is stopped with the test."""

    def __init__(self, routers: dict[str, str], link: Link, stack: AsyncExitStack) -> None:
        self.link = link
        self._routers = routers
        self._stack = stack
        self._watchers: dict[str, Agent] = {}

    async def watch(self) -> None:
        """Have an agent at each site that sees what is online there."""
        for number, site in enumerate("ab"):
            self._watchers[site] = await self.agent(site, "9", id=WATCHERS[number][1])

    def settings(self, site: str, zid: str = "") -> MeshSettings:
        """How to reach the mesh from a site; ``zid`` (hexadecimal) decides who keeps what two have."""
        return MeshSettings(connect=[self._routers[site]], overrides=[f'id:"{zid}"'] if zid else [])

    async def gateway(self, site: str, zid: str = "", **settings: object) -> Gateway:
        mesh = await self._stack.enter_async_context(await Mesh.open(self.settings(site, zid)))
        gateway = Gateway(mesh, changed(GatewaySettings(port=0, robots="any"), **settings))
        self._stack.push_async_callback(gateway.close)
        await gateway.start()
        return gateway

    async def gateway_process(self, site: str, zid: str) -> Program:
        (endpoint,) = self.settings(site).connect
        program = Program("gateway", "--port", "0", "-e", endpoint, "--cfg", f'id:"{zid}"')
        return await self._stack.enter_async_context(program)

    async def headset(self, gateway: Gateway | Program, **options: Any) -> Headset:
        return await self._stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port, **options))

    async def agent(self, site: str, kind: str, zid: str = "", **options: Any) -> Agent:
        joining = macs_zenoh.join(kind, settings=self.settings(site, zid), **options)
        return await self._stack.enter_async_context(joining)

    async def robot(self, site: str, agent_id: int) -> Robot:
        return Robot(await self.agent(site, "ros", id=agent_id), self._stack)

    async def part(self) -> None:
        """Cut the link, and wait until each site knows that it is alone, its router included."""
        self.link.cut()
        a, b = (self._watchers[site].directory for site in "ab")
        await until(lambda: WATCHERS[1] not in a and WATCHERS[0] not in b)
        await asyncio.sleep(FORGOTTEN_S)

    async def meet(self) -> float:
        """Mend the link, and wait until the sites see each other. Returns when that was."""
        self.link.mend()
        a, b = (self._watchers[site].directory for site in "ab")
        await until(lambda: WATCHERS[1] in a and WATCHERS[0] in b)
        return time.monotonic()

    def claims(self, site: str) -> list[tuple[int, int]]:
        """(type, id) of every claim that is seen at a site."""
        return [agent.key for agent in self._watchers[site].directory.claims()]

    async def right(
        self,
        met_at: float,
        expected: Iterable[tuple[int, int]],
        gateways: Iterable[Gateway] = (),
        within_s: float = PATIENCE_S,
    ) -> None:
        """Wait until everybody sees exactly these agents, each once; it must not take longer than the limit."""
        wanted = Counter([*expected, *WATCHERS])
        views = [self._watchers["a"].directory, self._watchers["b"].directory, *(g.directory for g in gateways)]

        def wrong() -> list[str]:
            seen = [Counter(agent.key for agent in view.claims()) for view in views]
            return [f"{sorted(s - wanted)} too many, {sorted(wanted - s)} missing" for s in seen if s != wanted]

        while wrong() and time.monotonic() < met_at + within_s:
            await asyncio.sleep(0.02)
        assert not wrong()


class Robot:
    """A robot that keeps its registrants, publishes its topic /chatter to them and answers its service /set."""

    def __init__(self, agent: Agent, stack: AsyncExitStack) -> None:
        self.agent = agent
        self.registrants: dict[tuple[int, str], set[int]] = {}
        self.answer_after: asyncio.Event | None = None
        self.added: asyncio.Event | None = None
        """Set by each `add_node`, which is then not answered."""
        agent.serve("add_node", self._add)
        agent.serve("remove_node", self._remove)
        serving = asyncio.ensure_future(self._serve())
        stack.callback(serving.cancel)

    def chatter(self, text: bytes) -> None:
        """Publish once, as the robot agent does."""
        metadata = Metadata(
            1, self.agent.id, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__chatter", "std_msgs/String"
        )
        registrants = sorted(self.registrants.get((NodeType.SUBSCRIBER, "nd__chatter"), ()))
        management = encode_management(StreamData({"2": registrants}))
        frame = encode_frame(1, management=management, message=encode_message(metadata.encode(), text))
        Streams(self.agent).publish("nd__chatter", frame)

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(AddNode, call.data)
        self.registrants.setdefault((node.node_type, node.node_name), set()).add(node.registrant_agent_id)
        if self.added is not None:
            self.added.set()
            await asyncio.sleep(30)
        return b""

    async def _remove(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(RemoveNode, call.data)
        self.registrants[node.node_type, node.node_name].discard(node.registrant_agent_id)
        return b""

    async def _serve(self) -> None:
        async for message in self.agent:
            if message.metadata.node_type == NodeType.CLIENT:
                if self.answer_after is not None:
                    await self.answer_after.wait()
                self.agent.send(
                    b"done: " + message.data,
                    to="unity",
                    ids=[message.sender_id],
                    metadata=Metadata(
                        request_id=message.metadata.request_id,
                        node_type=NodeType.CLIENT,
                        node_name=message.metadata.node_name,
                    ),
                )


class RobotProgram:
    """An existing robot program: behind a gateway, and without an idea of later ids."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.id = 0
        self._reader = reader
        self._writer = writer
        self._decoder = MessageDecoder(1 << 20)
        self._messages: list[Incoming] = []

    @classmethod
    @asynccontextmanager
    async def connected(cls, gateway: Gateway) -> AsyncIterator[RobotProgram]:
        """Connects and says that it is a robot."""
        robot = cls(*await asyncio.open_connection("127.0.0.1", gateway.port))
        try:
            welcome = await robot.next()
            robot.id = decode_data(Welcome, welcome.data).agent_id
            configuration = Configuration(ROS, robot.id, 0, welcome.metadata.request_id)
            robot._writer.write(encode_frame(management=encode_management(configuration)))
            await until(lambda: gateway.agents.find(ROS, robot.id))
            yield robot
        finally:
            robot._writer.transport.abort()

    def send(self, data: bytes, ids: list[int]) -> None:
        """Send to headsets, with the id that it was given first."""
        message = encode_message(Metadata(ROS, self.id).encode(), data)
        self._writer.write(encode_frame(UNITY, tuple(ids), message=message))

    async def next(self) -> Incoming:
        """The next message that comes."""
        while not self._messages:
            received = await asyncio.wait_for(self._reader.read(65536), PATIENCE_S)
            assert received, "the gateway closed the connection"
            for raw in self._decoder.feed(received):
                metadata, data = split_message(raw)
                self._messages.append(Incoming(Metadata.decode(metadata), bytes(data)))
        return self._messages.pop(0)

    async def until(self, data: bytes) -> Incoming:
        """The next message with this data; no other id may be among those before."""
        while (message := await self.next()).data != data:
            assert message.metadata.message_manager != Welcome.manager
        return message


@pytest.fixture
async def sites() -> AsyncIterator[Sites]:
    """Two sites that see each other."""
    async with AsyncExitStack() as stack:
        a = await stack.enter_async_context(Router())
        link = await stack.enter_async_context(counted(a.endpoint))
        b = await stack.enter_async_context(Router(connect=[link.endpoint], overrides=[SOON]))
        sites = Sites({"a": a.endpoint, "b": b.endpoint}, link, stack)
        await sites.watch()
        await sites.meet()
        yield sites


def errors(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What was logged as an error."""
    return sorted(record.getMessage() for record in caplog.records if record.levelno == logging.ERROR)


async def next_with(headset: Headset, data: bytes) -> Incoming:
    """The next message with this data; others, as the router's own, are passed over."""
    while (message := await headset.receive(PATIENCE_S)).data != data:
        pass
    return message


async def heard(robot: Robot, stream: Subscription, text: bytes) -> None:
    """Publish until the headset hears it: a registration may be on its way; nothing may come twice. No other text that
    it may have heard begins like this."""

    async def next_number() -> int:
        while not (data := (await stream.__anext__()).data).startswith(text):
            pass
        return int(data.rpartition(b" ")[2])

    arriving = asyncio.ensure_future(next_number())
    number = 0
    while not arriving.done():
        number += 1
        robot.chatter(b"%s %d" % (text, number))
        await asyncio.wait([arriving], timeout=0.1)
    came = [await arriving]
    robot.chatter(b"%s %d" % (text, number + 1))
    while came[-1] <= number:
        came.append(await asyncio.wait_for(next_number(), PATIENCE_S))
    assert came == list(range(came[0], number + 2))


async def test_gateways_with_different_blocks_part_and_meet(sites: Sites) -> None:
    """Gateways that held different blocks keep them and all ids; inside each site everything works while they are
    parted, and between them when they met."""
    here, there = await sites.gateway("a"), await sites.gateway("b")
    assert here.blocks != there.blocks
    headsets = [await sites.headset(gateway) for gateway in (here, here, there, there)]
    ids = [headset.id for headset in headsets]
    everybody = [(UNITY, agent_id) for agent_id in ids]
    await sites.right(time.monotonic(), everybody, [here, there])
    await sites.part()
    await until(lambda: here.directory.ids(UNITY) == ids[:2] and there.directory.ids(UNITY) == ids[2:])
    for one, other in (headsets[:2], headsets[2:]):
        await one.send(b"inside", to=UNITY, ids=[other.id])
        await next_with(other, b"inside")
    met_at = await sites.meet()
    await sites.right(met_at, everybody, [here, there])
    assert [headset.id for headset in headsets] == ids
    await headsets[0].send(b"across", to=UNITY, ids=[ids[3]])
    await next_with(headsets[3], b"across")


@pytest.mark.parametrize("later_keeps", [False, True], ids=["the earlier keeps", "the later keeps"])
async def test_both_sites_have_leased_the_same_block(sites: Sites, later_keeps: bool) -> None:
    """Of two gateways that leased the same block while they were parted, one gives it up: its headsets get other ids
    on the sockets they have, and still receive by id, by group and by topic, send, and have their calls answered."""
    await sites.part()
    zids = ("bb", "aa") if later_keeps else ("aa", "bb")
    gateways = {site: await sites.gateway(site, zid) for site, zid in zip("ab", zids, strict=True)}
    robots = {site: await sites.robot(site, number + 1001) for number, site in enumerate("ab")}
    headsets = {site: [await sites.headset(gateway, group=3) for _ in "12"] for site, gateway in gateways.items()}
    assert [headset.id for both in headsets.values() for headset in both] == [1, 2, 1, 2]
    streams = {
        site: [
            await h.subscribe("/chatter", "std_msgs/String", agents=[robots[site].agent.id]) for h in headsets[site]
        ]
        for site in "ab"
    }
    for site in "ab":
        for stream, text in zip(streams[site], (b"parted, one", b"parted, other"), strict=True):
            await asyncio.wait_for(heard(robots[site], stream, text), PATIENCE_S)
        await headsets[site][0].send(b"inside", to=UNITY, ids=[2])
        assert (await headsets[site][1].receive(PATIENCE_S)).data == b"inside"

    met_at = await sites.meet()
    keeps, moves = ("b", "a") if later_keeps else ("a", "b")
    expected = [(1, 1001), (1, 1002), (2, 1), (2, 2), (2, 256), (2, 257)]
    await sites.right(met_at, expected, gateways.values())
    assert [h.id for h in headsets[keeps]] == [1, 2]
    await until(lambda: sorted(h.id for h in headsets[moves]) == [256, 257])
    assert gateways[keeps].blocks == [0]
    assert gateways[moves].blocks == [1]
    for site in "ab":
        robot, (first, second) = robots[site], headsets[site]
        for stream, text in zip(streams[site], (b"together, one", b"together, other"), strict=True):
            await asyncio.wait_for(heard(robot, stream, text), PATIENCE_S)
        assert robot.registrants == {(NodeType.SUBSCRIBER, "nd__chatter"): {first.id, second.id}}
        await first.send(b"by id", to=UNITY, ids=[second.id])
        assert (await next_with(second, b"by id")).sender_id == first.id
        assert await first.call("/set", "std_srvs/SetBool", robot.agent.id, b"1") == b"done: 1"
    await headsets[moves][0].send(b"group", to=UNITY, groups=[3])
    for headset in (headsets[moves][1], *headsets[keeps]):
        assert (await next_with(headset, b"group")).sender_id == headsets[moves][0].id
    online = await headsets[moves][0].online()
    assert online.unity_agent_ids == [1, 2, 256, 257]
    assert online.ros_agent_ids == [1001, 1002]


async def test_an_answer_to_the_former_id_arrives(sites: Sites) -> None:
    """A service call that a headset made before it got another id is answered after it."""
    await sites.part()
    here, there = await sites.gateway("a", "aa"), await sites.gateway("b", "bb")
    robot = await sites.robot("b", 1002)
    robot.answer_after = asyncio.Event()
    await sites.headset(here)
    headset = await sites.headset(there)
    calling = asyncio.ensure_future(headset.call("/set", "std_srvs/SetBool", 1002, b"1"))
    await until(lambda: robot.registrants.get((NodeType.CLIENT, "nd__set")) == {1})
    await sites.right(await sites.meet(), [(1, 1002), (2, 1), (2, 256)], [here, there])
    await until(lambda: headset.id == 256)
    robot.answer_after.set()
    assert await calling == b"done: 1"
    assert robot.registrants[NodeType.CLIENT, "nd__set"] == {256}


async def test_who_leaves_before_it_has_its_other_id_is_forgotten(sites: Sites) -> None:
    """A robot that was told the id that a headset was about to have is told to forget it when the headset leaves
    first: no presence ever ends under that id."""
    await sites.part()
    await sites.headset(await sites.gateway("a", "aa"))
    there = await sites.gateway("b", "bb")
    robot = await sites.robot("b", 1002)
    headset = await sites.headset(there)
    await asyncio.wait_for(
        heard(robot, await headset.subscribe("/chatter", "std_msgs/String", agents=[1002]), b"parted"), 10
    )
    robot.added = asyncio.Event()
    await sites.meet()
    await asyncio.wait_for(robot.added.wait(), PATIENCE_S)
    registrants = robot.registrants[NodeType.SUBSCRIBER, "nd__chatter"]
    assert registrants == {1, 256}
    robot.added = None
    await headset.close()
    await until(lambda: 256 not in registrants)
    assert (UNITY, 256) not in there.directory


async def test_the_winner_keeps_what_it_registered_at_the_other_site(sites: Sites) -> None:
    """When both headsets of one id are registered on one robot, both get its topic after the merge, each once."""
    here, there = await sites.gateway("a", "aa", block=0), await sites.gateway("b", "bb", block=1)
    robot = await sites.robot("b", 1002)
    winner = await sites.headset(here)
    stream = await winner.subscribe("/chatter", "std_msgs/String", agents=[1002])
    await asyncio.wait_for(heard(robot, stream, b"before"), PATIENCE_S)
    await sites.part()
    await there.close()
    there = await sites.gateway("b", "bc")
    loser = await sites.headset(there)
    assert (winner.id, loser.id) == (1, 1)
    streams = [stream, await loser.subscribe("/chatter", "std_msgs/String", agents=[1002])]
    await asyncio.wait_for(heard(robot, streams[1], b"parted"), PATIENCE_S)
    await sites.right(await sites.meet(), [(1, 1002), (2, 1), (2, 256)], [here, there])
    await until(lambda: robot.registrants == {(NodeType.SUBSCRIBER, "nd__chatter"): {1, 256}})
    for each, text in zip(streams, (b"together, one", b"together, other"), strict=True):
        await asyncio.wait_for(heard(robot, each, text), PATIENCE_S)


async def test_two_agents_have_leased_the_same_id(sites: Sites, caplog: pytest.LogCaptureFixture) -> None:
    """Of two agents that took the same free id while they were parted, one gets another and goes on under it: it
    receives, serves, sends and publishes; the program hears of it, and what fails there changes nothing."""
    await sites.part()
    one, two = await sites.agent("a", "ros", "aa"), await sites.agent("b", "ros", "bb")
    assert (one.id, two.id) == (1, 1)
    changes: list[tuple[int, int]] = []

    def changed_to(old: int, new: int) -> None:
        changes.append((old, new))
        raise RuntimeError("the program's own fault")

    two.on_id(changed_to)

    async def name(call: macs_zenoh.Call) -> bytes:
        return f"{two.id}".encode()

    two.serve("name", name)
    other = await sites.agent("b", "unity", id=700)
    assert await other.call("ros", 1, "name") == b"1"
    await sites.right(await sites.meet(), [(1, 1), (1, 2), (2, 700)])
    assert (one.id, two.id) == (1, 2)
    assert changes == [(1, 2)]
    assert errors(caplog) == ["handling the new id of ros/2 failed"]
    assert await other.call("ros", 2, "name") == b"2"
    other.send(b"to two", to="ros", ids=[2])
    assert (await asyncio.wait_for(two.receive(), PATIENCE_S)).data == b"to two"
    two.send(b"from two", to="unity", ids=[700])
    assert (await asyncio.wait_for(other.receive(), PATIENCE_S)).sender_id == 2
    streamed: list[str] = []
    watching = other.mesh.subscribe("macs/from/**", lambda batch: streamed.extend(key for key, _ in batch))
    while not streamed:
        Streams(two).publish("nd__x", b"")
        await asyncio.sleep(0.05)
    watching.close()
    assert set(streamed) == {"macs/from/ros/2/nd__x"}


async def test_an_agent_uses_robots_under_its_new_id(sites: Sites) -> None:
    """What an agent had asked of a robot holds under the id it has to take, and is taken back for the old one."""
    await sites.part()
    one, two = await sites.agent("a", "unity", "aa"), await sites.agent("b", "unity", "bb")
    assert one.id == two.id
    robot = await sites.robot("b", 1002)
    await until(lambda: (1, 1002) in two.directory)
    chatter = await two.subscribe("/chatter", robot=1002, type="std_msgs/String")

    async def heard(text: bytes) -> None:
        while True:
            robot.chatter(text)
            with contextlib.suppress(asyncio.TimeoutError):
                while (await asyncio.wait_for(chatter.receive(), 0.2)).data != text:
                    pass
                return

    await asyncio.wait_for(heard(b"parted"), PATIENCE_S)
    assert await two.call_service("/set", b"x", robot=1002, type="std_srvs/SetBool") == b"done: x"
    await sites.meet()
    await until(lambda: two.id != one.id)
    topic, service = (NodeType.SUBSCRIBER, "nd__chatter"), (NodeType.CLIENT, "nd__set")
    await until(lambda: robot.registrants == {topic: {two.id}, service: {two.id}})
    await asyncio.wait_for(heard(b"together"), PATIENCE_S)
    assert await two.call_service("/set", b"y", robot=1002) == b"done: y"


async def test_what_fails_for_one_agent_stops_no_other(
    sites: Sites, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A fault of ours while ids change costs its own agent at most, and is told: others get their ids, the id that
    was set aside is free again, and a round that fails as a whole is repeated."""
    await sites.part()
    here, there = await sites.gateway("a", "aa"), await sites.gateway("b", "bb")
    await sites.headset(here), await sites.headset(here)
    headsets = [await sites.headset(there) for _ in "12"]
    assert [headset.id for headset in headsets] == [1, 2]
    monkeypatch.setattr(renumbering, "AGAIN_S", 0.1)
    prepare, more = RobotCalls.to_prepare, Leases.more
    attempts: list[int] = []

    def failing(calls: RobotCalls, agent: AgentKey, agent_id: int) -> list[Task]:
        if agent == (UNITY, 1):
            raise RuntimeError("of one agent")
        return prepare(calls, agent, agent_id)

    async def failing_once(leases: Leases) -> None:
        attempts.append(1)
        if len(attempts) == 1:
            raise RuntimeError("of all")
        await more(leases)

    monkeypatch.setattr(RobotCalls, "to_prepare", failing)
    monkeypatch.setattr(Leases, "more", failing_once)
    await sites.meet()
    await until(lambda: headsets[1].id != 2)
    assert (headsets[0].id, headsets[1].id) == (1, 257)
    await until(lambda: len(errors(caplog)) == 2)
    assert there.agents.ids == {1, 257}
    told = {str(record.exc_info[1]) for record in caplog.records if record.exc_info}
    assert told == {"of all", "of one agent"}


async def test_a_registration_that_a_rule_refuses_keeps_nobody_from_its_id(router: str) -> None:
    """What a traffic rule does not let pass is not told to the robot, and nothing else happens."""
    faults: list[str] = []
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda _, context: faults.append(context["message"]))
    rules = [TrafficRule(match="macs/**", max_bytes=1)]
    async with await Mesh.open(MeshSettings(connect=[router]), traffic=rules) as mesh:
        calls = RobotCalls(mesh, Directory(), Layout(), on_streams=lambda _: None, on_refused=lambda *_: None)
        told = await calls.prepare(
            [Task(7, AddNode(UNITY, 256, NodeType.SUBSCRIBER, "nd__x", "/x", "std_msgs/String"))], set()
        )
    gc.collect()
    await asyncio.sleep(0)
    assert told == []
    assert mesh.drops["over_size"] == 1
    assert faults == []


@pytest.mark.parametrize("zids", [("aa", "bb"), ("bb", "aa")], ids=["the smaller leased", "the greater leased"])
async def test_who_leased_an_id_leaves_it_to_who_was_given_it(sites: Sites, zids: tuple[str, str]) -> None:
    """Where one of two agents was given the id by its configuration, the other gets another one, whoever is right by
    the sessions' names; nobody complains."""
    await sites.part()
    leased, given = await sites.agent("a", "ros", zids[0]), await sites.agent("b", "ros", zids[1], id=1)
    assert leased.id == 1
    await sites.right(await sites.meet(), [(1, 1), (1, 2)])
    assert (leased.id, given.id) == (2, 1)


async def test_the_same_configured_ids(sites: Sites, caplog: pytest.LogCaptureFixture) -> None:
    """What is configured twice stays as it is: every holder says so once, with the other's session, and `macs ls`
    shows both; headsets of gateways with the same configured block still get distinct ids."""
    await sites.part()
    robots = [await sites.agent("a", "ros", "a1", id=7), await sites.agent("b", "ros", "b1", id=7)]
    gateways = [await sites.gateway("a", "a2", block=3), await sites.gateway("b", "b2", block=3)]
    headsets = [await sites.headset(gateway) for gateway in gateways]
    assert [headset.id for headset in headsets] == [768, 768]
    await sites.right(await sites.meet(), [(1, 7), (1, 7), (2, 768), (2, 769)], gateways)
    assert [robot.id for robot in robots] == [7, 7]
    await until(lambda: [headset.id for headset in headsets] == [768, 769])
    assert [gateway.blocks for gateway in gateways] == [[3], [3]]
    await headsets[0].send(b"across", to=UNITY, ids=[769])
    await next_with(headsets[1], b"across")
    await until(lambda: len(errors(caplog)) == 4)
    assert [message.split(":")[0] for message in errors(caplog)] == [
        "block 3 is also leased by session a2",
        "block 3 is also leased by session b2",
        "ros/7 is also held by session a1",
        "ros/7 is also held by session b1",
    ]
    listed = await macs("ls", "--json", "-e", sites.settings("b").connect[0])
    assert [row["zid"] for row in listed if (row["type"], row["id"]) == ("ros", 7)] == ["a1", "b1"]


async def test_a_robot_program_keeps_its_id_unless_another_has_it(sites: Sites) -> None:
    """A robot behind the gateway that loses its block keeps its id and its socket; one whose id another robot has
    gets a new one without being told, is told that its registrants are gone, and speaks under the new one."""
    await sites.part()
    here, there = await sites.gateway("a", "aa"), await sites.gateway("b", "bb")
    async with AsyncExitStack() as stack:
        first, second = [await stack.enter_async_context(RobotProgram.connected(there)) for _ in "12"]
        other = await stack.enter_async_context(RobotProgram.connected(here))
        headset = await sites.headset(there)
        assert (other.id, first.id, second.id, headset.id) == (1, 1, 2, 3)
        await headset.subscribe("/chatter", "std_msgs/String", agents=[1, 2])
        for robot in (first, second):
            assert (await robot.next()).metadata.message_manager == AddNode.manager
        await sites.right(await sites.meet(), [(1, 1), (1, 2), (1, 256), (2, 257)], [here, there])
        gone = await first.next()
        assert gone.metadata.message_manager == AgentsGone.manager
        assert decode_data(AgentsGone, gone.data).agents == [GoneAgent(UNITY, 3)]
        first.send(b"hello", [257])
        assert (await next_with(headset, b"hello")).sender_id == 256
        await headset.advertise("/talk", "std_msgs/String", agents=[256])
        while (await first.next()).metadata.message_manager != AddNode.manager:
            pass
        text = CDR + b"\x06\x00\x00\x00to it\x00"
        await headset.publish("/talk", "std_msgs/String", text, agents=[256])
        assert (await first.until(text)).metadata.sender_agent_id == 257


async def test_parting_again_while_ids_change(sites: Sites) -> None:
    """A link that comes and goes leaves everybody with one id in the end, and the sockets open."""
    await sites.part()
    gateways = [await sites.gateway("a", "aa"), await sites.gateway("b", "bb")]
    headsets = [await sites.headset(gateway) for gateway in gateways for _ in range(5)]
    for pause_s in (0.0, 0.1, 0.3, 0.5):
        await sites.meet()
        await asyncio.sleep(pause_s)  # not to wait for something: each time the cut comes at another step
        await sites.part()
    met_at = await sites.meet()
    await until(lambda: len({headset.id for headset in headsets}) == 10)
    ids = [headset.id for headset in headsets]
    assert ids[:5] == [1, 2, 3, 4, 5]
    await sites.right(met_at, [(UNITY, agent_id) for agent_id in ids], gateways)
    await headsets[0].send(b"across", to=UNITY, ids=ids[-3:])
    for headset in headsets[-3:]:
        await next_with(headset, b"across")


@pytest.mark.alone
async def test_a_hundred_headsets_change_their_ids_at_once(sites: Sites) -> None:
    """A merge in which all ids of a gateway are taken is over in time: every headset has a new id on its socket, and a
    robot at which each is registered knows all of them and none under its old id."""
    await sites.part()
    robot = await sites.robot("b", 1002)
    staying, moving = [
        [await sites.headset(gateway) for _ in range(100)]
        for gateway in [await sites.gateway_process("a", "aa"), await sites.gateway_process("b", "bb")]
    ]
    for headset in moving:
        await headset.subscribe("/chatter", "std_msgs/String", agents=[1002])
    node = (NodeType.SUBSCRIBER, "nd__chatter")
    await until(lambda: robot.registrants.get(node) == set(range(1, 101)))
    # with 200 each it took 1.1 to 1.9 s on two busy cores
    everybody = [(1, 1002), *((UNITY, n) for n in [*range(1, 101), *range(256, 356)])]
    await sites.right(await sites.meet(), everybody, within_s=RIGHT_S)
    await until(lambda: {headset.id for headset in moving} == set(range(256, 356)))
    assert [headset.id for headset in staying] == list(range(1, 101))
    await until(lambda: robot.registrants[node] == set(range(256, 356)))
