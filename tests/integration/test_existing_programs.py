"""Nothing that deafens an existing program reaches one: every name, metadata and shape of data, from everybody, by
every way, and what the two existing programs make of what they get, as docs/protocol.md and the recordings tell it."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import pytest

import macs_zenoh
from bridge.gateway import Gateway
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Refused, WireError
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import BROADCAST, GROUP, STREAM
from macs_zenoh.protocol.messages import (
    MANAGERS,
    ROS,
    UNITY,
    AddNode,
    Functionality,
    Metadata,
    StreamData,
    encode_data,
    encode_management,
)
from macs_zenoh.protocol.routing import call, unicast_key
from macs_zenoh.protocol.wire import encode_frame, encode_message
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.matching import matched
from tests.support.waiting import PATIENCE_S, until

TYPES = {"nd__chatter": "std_msgs/String", "nd__cmd": "std_msgs/String", "nd__set": "std_srvs/SetBool"}
TYPES["nd__serve"] = "std_srvs/SetBool"
ROS_SPELLING = {name: [kind.replace("/", f"/{part}/") for part in ("msg", "srv")] for name, kind in TYPES.items()}
KINDS = {"nd__chatter": 1, "nd__cmd": 2, "nd__set": 3, "nd__serve": 4}
GROUP_ID = 3
OFFERS = {"subscribers": {"/cmd": "std_msgs/msg/String"}, "publishers": {}, "services": {}}
HEADER = b"\x00\x01\x00\x00"
TEXT = HEADER + b"\x03\x00\x00\x00hi\x00"
DONE = HEADER + b"\x05\x00\x00\x00done\x00"
ANSWER = HEADER + b"\x01\x00\x00\x00\x03\x00\x00\x00ok\x00"

# -- the two existing programs, as far as they are known ------------------------------------------------------------


class Deaf(Exception):
    """The program's thread for messages has ended."""


def read_metadata(raw: bytes) -> dict[str, Any]:
    """Metadata as both programs read it: the seven keys, each of its type."""
    if not raw:
        raise Deaf("metadata of length 0")
    try:
        fields = json.loads(raw)
    except ValueError as error:
        raise Deaf(f"metadata that is no JSON: {raw[:60]!r}") from error
    texts, numbers = ("messageManager", "nodeName", "dataExchangeType"), ("requestId", "nodeType")
    if not isinstance(fields, dict) or not all(isinstance(fields.get(key), str) for key in texts):
        raise Deaf(f"metadata without its texts: {raw[:80]!r}")
    if not all(type(fields.get(key)) is int for key in numbers):
        raise Deaf(f"metadata without its numbers: {raw[:80]!r}")
    folded = [key for key in re.findall(r'"(\w+)":', raw.decode()) if key.lower().replace("_", "") == "nodename"]
    if folded != ["nodeName"]:
        raise Deaf(f"a node's name in two ways: {raw[:80]!r}")
    return fields


def read_cdr(data: bytes, name: str, *, answer: bool) -> None:
    """Take ROS data as the type of this node."""
    if data[:4] != HEADER:
        raise Deaf(f"{data[:20]!r} on {name}, which is no CDR")
    if len(data) < 5:
        raise Deaf(f"{data!r} on {name}, which is cut short")
    if TYPES[name] == "std_msgs/String" or answer:
        at = 4 if TYPES[name] == "std_msgs/String" else 8
        size = struct.unpack_from("<I", data, at)[0] if len(data) >= at + 4 else 1 << 30
        if at + 4 + size > len(data):
            raise Deaf(f"{data[:20]!r} on {name}, which is cut short")


class Program:
    """An existing program on its socket. ``deaf`` is why, once it is; ``got`` counts what it took."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, kind: int) -> None:
        self.writer, self.kind = writer, kind
        self.id = 0
        self.deaf = ""
        self.got: list[tuple[dict[str, Any], bytes]] = []
        self._reading = asyncio.ensure_future(self._read(reader))

    @classmethod
    async def start(cls, gateway: Gateway) -> Program:
        """Connect, and configure as such programs do."""
        self = cls(*await asyncio.open_connection("127.0.0.1", gateway.port))  # type: ignore[call-arg]
        await until(lambda: self.id or self.deaf)
        told = {"agentType": self.kind, "agentId": self.id, "groupId": GROUP_ID, "requestId": 1}
        told |= {"functionality": OFFERS} if self.kind == ROS else {}
        self.manage("AgentclientConfigurer", told)
        await until(lambda: gateway.agents.find(self.kind, self.id))
        return self

    def manage(self, manager: str, told: dict[str, Any], message: bytes = bytes(8)) -> None:
        """Send management data."""
        management = json.dumps({"messageManager": manager, **told}).encode()
        self.writer.write(encode_frame(management=management, message=message))

    def say(self, to: int, ids: list[int], data: bytes, **fields: Any) -> None:
        """Send a message."""
        fields = {"messageManager": "", "requestId": 0, "nodeType": 0, "nodeName": "", **fields}
        fields = {"senderAgentType": self.kind, "senderAgentId": self.id, "dataExchangeType": "", **fields}
        self.writer.write(encode_frame(to, ids, message=encode_message(json.dumps(fields).encode(), data)))

    async def close(self) -> None:
        """End the connection."""
        self._reading.cancel()
        self.writer.close()

    async def _read(self, reader: asyncio.StreamReader) -> None:
        with suppress(asyncio.IncompleteReadError, ConnectionError):
            while not self.deaf:
                metadata = await reader.readexactly(struct.unpack("<i", await reader.readexactly(4))[0])
                data = await reader.readexactly(struct.unpack("<i", await reader.readexactly(4))[0])
                try:
                    fields = read_metadata(metadata)
                    self.take(fields, data)
                    self.got.append((fields, data))
                except Deaf as end:
                    self.deaf = f"{end} ({metadata[:200]!r})"

    def take(self, fields: dict[str, Any], data: bytes) -> None:
        """Handle a message. Raises Deaf."""
        raise NotImplementedError

    def take_welcome(self, fields: dict[str, Any], data: bytes) -> None:
        """The id, from the router only."""
        if fields["senderAgentType"] is not None or self.id:
            raise Deaf(f"another id: {data!r}")
        self.id = json.loads(data)["agentId"]


class Headset(Program):
    """The headset in C#: nodes by name, managers by the names of classes, answers by their number."""

    CLASSES = {*MANAGERS, "ManagementMessageManager"} - {"InterfaceNodeRefused"}

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(reader, writer, UNITY)
        self.robots: set[int] = set()
        """On which it has registered its nodes."""
        self.asked: set[int] = set()

    def register(self, robot: int) -> None:
        """Register its four nodes on a robot."""
        self.robots.add(robot)
        for name, kind in KINDS.items():
            self.manage(*registration(self.id, robot, name, kind))

    def take(self, fields: dict[str, Any], data: bytes) -> None:
        name, manager = fields["nodeName"], fields["messageManager"]
        if name:
            if name not in KINDS:
                return
            if fields["nodeType"] != KINDS[name]:
                raise Deaf(f"{name} as type {fields['nodeType']}")
            if fields["senderAgentType"] != ROS or fields["senderAgentId"] not in self.robots:
                raise Deaf(f"{name} of another than its robots")
            if KINDS[name] == 2:
                raise Deaf(f"a message for the publisher {name}")
            if fields["dataExchangeType"] not in (TYPES[name], *ROS_SPELLING[name]):
                raise Deaf(f"{fields['dataExchangeType']!r} read as {TYPES[name]}")
            read_cdr(data, name, answer=KINDS[name] == 3)
        elif manager == "AgentConfigurer":
            self.take_welcome(fields, data)
        elif manager == "PrunedUnityAgentsInterfaceNodesCleaner" and fields["senderAgentType"] is None:
            assert isinstance(json.loads(data)["agents"], list)
        elif manager in self.CLASSES or not re.fullmatch(r"\w*", manager, re.ASCII):
            raise Deaf(f"the class {manager!r}")
        elif not manager and fields["requestId"] in self.asked:
            self.asked.discard(fields["requestId"])
            if not data.startswith(b"{") or fields["senderAgentId"] not in (None, *self.robots):
                raise Deaf(f"{data[:30]!r} as an answer of {fields['senderAgentId']}")


class Robot(Program):
    """The robot in Python: one thread that ends on what it has no handling for."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(reader, writer, ROS)
        self.nodes: dict[str, tuple[int, str, str, set[int]]] = {}
        self.asked: set[int] = set()

    def take(self, fields: dict[str, Any], data: bytes) -> None:
        name, manager = fields["nodeName"], fields["messageManager"]
        if name:
            node = self.nodes.get(name)
            if node is None or node[0] != fields["nodeType"] or node[0] not in (2, 3, 4):
                raise Deaf(f"{name} of type {fields['nodeType']}, which it does not have")
            if node[0] == 4 and (fields["senderAgentId"] not in node[3] or fields["requestId"] not in self.asked):
                raise Deaf("an answer that it has not asked for")
            if fields["dataExchangeType"] != node[2]:
                raise Deaf(f"the type {fields['dataExchangeType']!r} for {node[2]}")
            read_cdr(data, name, answer=node[0] == 4)
        elif manager == "AgentConfigurer":
            self.take_welcome(fields, data)
        elif manager == "PrunedUnityAgentsInterfaceNodesCleaner" and fields["senderAgentType"] is None:
            gone = {agent["agent_id"] for agent in json.loads(data)["agents"]}
            self.nodes = {name: node for name, node in self.nodes.items() if node[3] - gone}
        elif manager == "InterfaceNodeAdder":
            self._add(json.loads(data))
        elif manager == "InterfaceNodeRemover":
            said = json.loads(data)
            self.nodes[said["nodeName"]][3].remove(said["registrantAgentId"])
        else:
            raise Deaf(f"the manager {manager!r}")

    def _add(self, said: dict[str, Any]) -> None:
        name, who = said["nodeName"], said["registrantAgentId"]
        new = (said["nodeType"], said["tosName"], said["dataExchangeType"])
        there = self.nodes.setdefault(name, (*new, set()))
        if there[:3] != new or who in there[3] or (new[0] == 4 and there[3]):
            raise Deaf(f"a second node {said}")
        if new[0] not in (1, 2, 3, 4) or new[2] not in {*TYPES.values()} or name != "nd_" + new[1].replace("/", "_"):
            raise Deaf(f"a node that cannot be made: {said}")
        there[3].add(who)


def registration(agent: int, robot: int, name: str, kind: int, **fields: Any) -> tuple[str, dict[str, Any], bytes]:
    """Management data and message of a registration."""
    node = {"nodeType": kind, "nodeName": name, "tosName": name[3:].replace("_", "/"), "dataExchangeType": "x/Y"}
    node |= {"dataExchangeType": TYPES.get(name, "x/Y"), **fields}
    adding = {"registrantAgentType": UNITY, "registrantAgentId": agent, **node}
    metadata = Metadata(UNITY, agent, message_manager="InterfaceNodeAdder").encode()
    told = {"registrantAgentId": agent, "registrarAgentIds": [robot], "registrarGroupIds": [], **node}
    return "RosAgentNodeRegistrationForwarder", told, encode_message(metadata, json.dumps(adding).encode())


# -- all that may be said --------------------------------------------------------------------------------

SHAPES = [
    b"",
    b"\x00",
    HEADER,
    TEXT[:-3],
    b"\x00\x00\x00\x03hi\x00",
    b"hello",
    b"{",
    b"{}",
    b'{"agentId": 9}',
    b"\xff" * 9,
]
NAMES = [
    *MANAGERS,
    *("ManagementMessageManager", "RobotStatus", "RobotControl", "InterfaceCallFailure", "Greeting", "ActionGoal"),
    *("os.system", "a b", "Grüße", "System.Console", "a" * 300, ""),
]
ODD = [
    b"",
    b"{}",
    b"[1]",
    b"{",
    b"\xff\xfe",
    b'{"nodeName":null}',
    b'{"nodeName":"","nodeName":"nd__chatter","nodeType":2}',
    b'{"NODENAME":"nd__chatter","nodeType":2}',
    b'{"node_name":"nd__chatter","node_type":2,"nodeName":""}',
    b'{"messageManager":"AgentConfigurer","senderAgentType":null,"senderAgentId":null}',
    b'{"nodeType":1.5}',
    b'{"requestId":-1}',
]
OTHER_TYPES = ["std_msgs/Bool", "std_msgs/msg/Bool", "geometry_msgs/Pose", "std_srvs/Trigger", "String", "os/path", ""]


def said(kind: int, agent: int) -> Iterator[tuple[bytes, bytes]]:
    """Metadata and data, all there are, of an agent that says it is this one."""
    for manager, data, number in itertools.product(NAMES, SHAPES, (0, 7)):
        yield Metadata(kind, agent, number, manager).encode(), data
    for name, node_type, data in itertools.product([*KINDS, "nd__none"], (0, 1, 2, 3, 4, 5, 255), SHAPES):
        manager = StreamData.manager if node_type == 1 else ""
        metadata = Metadata(kind, agent, 0, manager, node_type, name, TYPES.get(name, "std_msgs/String"))
        yield metadata.encode(), data
    for metadata, data in itertools.product(ODD, SHAPES):
        yield metadata, data
    yield (
        Metadata(kind, agent, 0, "InterfaceCallFailure", 3, "nd__set", "std_srvs/SetBool").encode(),
        b'{"kind":"absent"}',
    )
    for name, other in itertools.product(KINDS, OTHER_TYPES):
        manager = StreamData.manager if KINDS[name] == 1 else ""
        for number, data in itertools.product((0, 7), (HEADER + b"\x01", DONE)):
            yield Metadata(kind, agent, number, manager, KINDS[name], name, other).encode(), data


Send = Callable[[int, list[int], list[int], bytes, bytes], None]


def keys(to: int, ids: list[int], groups: list[int], kind: int, agent: int) -> list[str]:
    """Where a program on the mesh puts it."""
    if not to:
        return [BROADCAST.of(from_type=kind, from_id=agent)]
    return [unicast_key(to, each, kind, agent) for each in ids] + [
        GROUP.of(group=group, type=to, from_type=kind, from_id=agent) for group in groups
    ]


async def everything(send: Send, kind: int, agent: int, headset: Headset, robot: Robot, *, raw: bool) -> None:
    """Say it all: by id, by group and to everybody."""
    for count, (metadata, data) in enumerate(said(kind, agent)):
        if not raw:
            try:
                Metadata.decode(metadata)
            except WireError:
                continue
        for to, program in ((UNITY, headset), (ROS, robot)):
            send(to, [program.id], [], metadata, data)
            send(to, [], [GROUP_ID], metadata, data)
        send(0, [], [], metadata, data)
        if count % 50 == 0:
            await asyncio.sleep(0.01)  # no flood, for which there are limits of their own


@pytest.fixture
async def stage(start_gateway: StartGateway, connect: Connect) -> Any:
    """A gateway with an existing robot and an existing headset that uses all it has, and does so at the end."""
    gateway = await start_gateway(max_connections=100)
    robot, headset = await Robot.start(gateway), await Headset.start(gateway)  # type: ignore[call-arg]
    assert isinstance(headset, Headset)
    assert isinstance(robot, Robot)
    headset.register(robot.id)
    await until(lambda: len(robot.nodes) == len(KINDS) or robot.deaf)
    yield gateway, headset, robot
    served = Metadata(ROS, robot.id, 0, StreamData.manager, 1, "nd__chatter", "std_msgs/String")
    robot.manage(StreamData.manager, {"destAgents": {"2": [headset.id]}}, encode_message(served.encode(), DONE))
    headset.say(ROS, [robot.id], DONE, nodeType=2, nodeName="nd__cmd", dataExchangeType="std_msgs/String")
    await until(lambda: all(DONE in [data for _, data in each.got] or each.deaf for each in (headset, robot)))
    assert (headset.deaf, robot.deaf) == ("", "")
    for program in (headset, robot):
        await program.close()


@pytest.mark.parametrize("kind", [UNITY, ROS], ids=["headset", "robot"])
async def test_a_tcp_agent_deafens_nobody(kind: int, stage: tuple[Gateway, Headset, Robot]) -> None:
    """Whatever another headset or robot sends over TCP, also as topic data and as registrations, harms neither."""
    gateway, headset, robot = stage
    other = await (Headset if kind == UNITY else Robot).start(gateway)  # type: ignore[call-arg]

    def send(to: int, ids: list[int], groups: list[int], metadata: bytes, data: bytes) -> None:
        other.writer.write(encode_frame(to, ids, groups, message=encode_message(metadata, data)))

    await everything(send, kind, other.id, headset, robot, raw=True)
    for metadata, data in said(kind, other.id):
        targets = {"destAgents": {"2": [headset.id], "1": [robot.id]}}
        other.manage(StreamData.manager, targets, encode_message(metadata, data))
    wrong: list[dict[str, Any]] = [
        {"dataExchangeType": each} for each in ("os/Path", "no/Such", "std_msgs/NoSuch", "")
    ]
    wrong += [{"tosName": "/a b"}, {"nodeType": 5}, {"nodeName": "nd__cmd"}, {"bufferSize": 1 << 60}]
    for fields in wrong:
        other.manage(
            *registration(other.id, robot.id, "nd__x", 1, **{"dataExchangeType": "std_msgs/String", **fields})
        )
    other.manage(*registration(other.id, robot.id, "nd__serve", 4))
    await asyncio.wait_for(other.writer.drain(), PATIENCE_S)
    other.say(UNITY, [headset.id], b"{}", messageManager="Finished")
    await until(lambda: headset.deaf or headset.got[-1][0]["messageManager"] == "Finished", 60)
    other.writer.close()


@pytest.mark.parametrize("kind", [UNITY, ROS], ids=["headset", "robot"])
async def test_a_program_on_the_mesh_deafens_nobody(
    kind: int, router: str, stage: tuple[Gateway, Headset, Robot]
) -> None:
    """Whatever a Zenoh session puts, also in the name of the robot and on its topics, harms neither."""
    _, headset, robot = stage
    async with await Mesh.open(patient(router)) as mesh:
        for agent in (900, robot.id if kind == ROS else headset.id):

            def send(
                to: int, ids: list[int], groups: list[int], metadata: bytes, data: bytes, me: int = agent
            ) -> None:
                frame = encode_frame(to, ids, groups, message=encode_message(metadata, data))
                for key in keys(to, ids, groups, kind, me):
                    mesh.put(key, frame)

            await everything(send, kind, agent, headset, robot, raw=True)
            management = encode_management(StreamData({"2": [headset.id], "1": [robot.id]}))
            for name, (metadata, data) in itertools.product(KINDS, said(ROS, agent)):
                if kind == ROS:
                    frame = encode_frame(ROS, management=management, message=encode_message(metadata, data))
                    mesh.put(STREAM.of(type=ROS, id=agent, node=name), frame)
        message = encode_message(Metadata(message_manager="Finished").encode(), b"{}")
        finished = encode_frame(UNITY, (headset.id,), message=message)
        while not (headset.deaf or headset.got[-1][0]["messageManager"] == "Finished"):
            # more than once: so much at once may have cost the session its link, and what is put meanwhile is lost
            mesh.put(unicast_key(UNITY, headset.id, UNITY, 900), finished)
            await asyncio.sleep(0.2)


async def test_a_python_agent_deafens_nobody(router: str, stage: tuple[Gateway, Headset, Robot]) -> None:
    """What README shows, and the rest that the API can say, harms neither; questions to the robot are answered."""
    _, headset, robot = stage
    async with macs_zenoh.join("ros", id=900, settings=patient(router)) as agent:
        agent.broadcast(b"robot 900 is here")
        agent.send(b"got it", to="ros", ids=[robot.id])
        agent.send(b"got it", to="unity", ids=[headset.id])

        def send(to: int, ids: list[int], groups: list[int], metadata: bytes, data: bytes) -> None:
            if to:
                agent.send(data, to=str(to), ids=ids, groups=groups, metadata=Metadata.decode(metadata))
            else:
                agent.broadcast(data, metadata=Metadata.decode(metadata))

        await everything(send, ROS, 900, headset, robot, raw=False)
        assert json.loads(await agent.call("ros", robot.id, "offers")) == OFFERS
        for verb in ("status", "stop", "control", "x"):
            with pytest.raises(Refused, match="an existing program"):
                await agent.call("ros", robot.id, verb)
        node = AddNode(ROS, 900, 5, "nd__act", "/act", "std_msgs/String")
        key, frame = call((ROS, robot.id), "add_node", (ROS, 900), encode_data(node), Metadata(ROS, 900))
        with pytest.raises(Refused, match="no nodes of type 5"):
            await agent.mesh.query(key, frame, timeout_s=PATIENCE_S)
        agent.send(b"{}", to="unity", ids=[headset.id], metadata=Metadata(message_manager="Finished"))
        await until(lambda: headset.deaf or headset.got[-1][0]["messageManager"] == "Finished", 60)


@asynccontextmanager
async def lenient_robot(router: str) -> AsyncIterator[Agent]:
    """A robot on the mesh that lets anybody register."""
    async with macs_zenoh.join("ros", id=901, settings=patient(router)) as agent:

        async def add(_call: object) -> bytes:
            return b""

        agent.serve("add_node", add)
        yield agent


CUT = HEADER + b"\x06\x00\x00\x00done\x00"
DATA_OF = {"nd__chatter": [HEADER + b"\x01", DONE, CUT], "nd__set": [ANSWER], "nd__serve": [HEADER + b"\x01"]}


@pytest.mark.parametrize("way", ["TCP", "Zenoh", "agent"])
async def test_what_its_own_robot_says_is_of_its_type(
    way: str, router: str, stage: tuple[Gateway, Headset, Robot]
) -> None:
    """Topic data, requests and answers of a robot on which a headset registered reach it under the type that it has
    there, by id, by group, to all and as topic data; what names another type, or none, does not."""
    gateway, headset, robot = stage
    connection = gateway.agents.find(UNITY, headset.id)
    assert connection is not None
    async with await Mesh.open(patient(router)) as mesh, lenient_robot(router) as agent:
        if way == "agent":
            await until(lambda: (ROS, agent.id) in gateway.directory)
            headset.register(agent.id)
            await until(lambda: any(key.startswith(f"macs/from/ros/{agent.id}/") for key in gateway._delivery.streams))
            for key in list(gateway._delivery.streams):
                await matched(agent.mesh, key)
        by, session = (agent.id, agent.mesh) if way == "agent" else (robot.id, mesh)
        put = session.put if way != "TCP" else lambda _key, frame: robot.writer.write(frame)

        async def say(about: Metadata, data: bytes) -> None:
            message = encode_message(about.encode(), data)
            if about.node_type == 1:
                management = encode_management(StreamData({"2": [headset.id]}))
                frame = encode_frame(ROS, management=management, message=message)
                put(STREAM.of(type=ROS, id=by, node=about.node_name), frame)
                await asyncio.sleep(0.003)  # what comes alone takes another way in a gateway than many at once
            for to, ids, groups in ((UNITY, [headset.id], []), (UNITY, [], [GROUP_ID]), (0, [], [])):
                put(keys(to, ids, groups, ROS, by)[0], encode_frame(to, ids, groups, message=message))
            await asyncio.sleep(0.003)

        for name, data_of in DATA_OF.items():
            kind, right = KINDS[name], [TYPES[name], ROS_SPELLING[name][KINDS[name] != 1]]
            manager = StreamData.manager if kind == 1 else ""
            for number, said_type in enumerate([*OTHER_TYPES, *right]):
                if kind == 3:
                    asking = {"requestId": number, "nodeType": 3, "nodeName": name, "dataExchangeType": TYPES[name]}
                    headset.say(ROS, [by], HEADER + b"\x01", **asking)
                    answer = Metadata(ROS, by, number, "", 3, name)
                    await until(lambda answer=answer: connection.recipient.asked.awaits(answer))
                for _, data in itertools.product(range(3), data_of):
                    await say(Metadata(ROS, by, number, manager, kind, name, said_type), data)

            def heard(name: str = name) -> set[str]:
                return {fields["dataExchangeType"] for fields, _ in headset.got if fields["nodeName"] == name}

            await until(lambda right=right, heard=heard: headset.deaf or {*right} <= heard())
            assert headset.deaf == ""
            assert heard() == {*right}
        assert connection.drops["other_type"] >= 3 * len(OTHER_TYPES)


async def test_the_gateway_answers_for_an_existing_robot(
    stage: tuple[Gateway, Headset, Robot], connect: Connect
) -> None:
    """What a robot offers is in its configuration, the last one; what it does not know is refused with a reason."""
    gateway, _, robot = stage
    asking = await connect(gateway)
    assert json.loads(await asking.ask(robot.id, "FunctionalityGetter")) == OFFERS
    told = {"agentType": ROS, "agentId": robot.id, "groupId": GROUP_ID, "requestId": 1}
    robot.manage("AgentclientConfigurer", {**told, "functionality": {**OFFERS, "publishers": {"/a": "b/msg/C"}}})
    robot.say(UNITY, [asking.id], b"{}", messageManager="Configured")
    assert (await asking.receive(PATIENCE_S)).metadata.message_manager == "Configured"
    assert json.loads(await asking.ask(robot.id, "FunctionalityGetter"))["publishers"] == {"/a": "b/msg/C"}
    for manager in ("RobotStatus", "RobotControl", "MyOwn"):
        with pytest.raises(Refused, match=f"does not survive messages of {manager}"):
            await asking.ask(robot.id, manager)
    with pytest.raises(Refused, match="nobody registered nd__none"):
        await asking.call("/none", "no_such/Type", robot.id, TEXT, failures=True)


async def test_an_answer_comes_from_who_was_asked(stage: tuple[Gateway, Headset, Robot], router: str) -> None:
    """A headset's request to its robot is answered by that robot, once; and the robot's to the headset likewise."""
    _, headset, robot = stage
    headset.say(ROS, [robot.id], HEADER + b"\x01", nodeType=3, nodeName="nd__set", dataExchangeType=TYPES["nd__set"])
    await until(lambda: robot.deaf or [f for f, _ in robot.got if f["nodeName"] == "nd__set"])
    fields = {"nodeType": 3, "nodeName": "nd__set", "dataExchangeType": TYPES["nd__set"]}
    for _ in range(3):
        robot.say(UNITY, [headset.id], ANSWER, **fields)
    robot.asked.add(5)
    serving = {"nodeType": 4, "nodeName": "nd__serve", "dataExchangeType": TYPES["nd__serve"], "requestId": 5}
    robot.say(UNITY, [headset.id], HEADER + b"\x01", **serving)
    await until(lambda: headset.deaf or [f for f, _ in headset.got if f["nodeName"] == "nd__serve"])
    headset.say(ROS, [robot.id], ANSWER, **serving)
    headset.say(ROS, [robot.id], ANSWER, **serving)
    await until(lambda: robot.deaf or [f for f, _ in robot.got if f["nodeName"] == "nd__serve"])
    assert len([f for f, _ in headset.got if f["nodeName"] == "nd__set"]) == 1


def test_functionality_is_read_as_it_is_written() -> None:
    """The robot's own spelling of what it offers is that of the answer."""
    assert Functionality(**OFFERS) == Functionality(subscribers={"/cmd": "std_msgs/msg/String"})
