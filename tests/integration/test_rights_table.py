"""Each right on each port: one attempt that it allows and one that it does not, by id, by group and by name, for what
robots hear, for what headsets hear, and for who may join as what."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import NamedTuple

import pytest

from bridge.headset import frames
from bridge.headset.client import Headset
from bridge.headset.frames import NodeSpec
from bridge.headset.stream import open_stream
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Refused, Unreachable
from macs_zenoh.joining import join
from macs_zenoh.protocol.messages import (
    EVERYBODY,
    ROS,
    UNITY,
    AddNode,
    Configuration,
    NodeType,
    decode_data,
    encode_management,
)
from macs_zenoh.protocol.rights import RIGHTS, Right
from macs_zenoh.protocol.wire import encode_frame
from macs_zenoh.serving import Call
from tests.integration.test_door import NOBODY, PORTS, Door, StartDoor, Tokens
from tests.support.certificates import Authority
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.waiting import PATIENCE_S, until

CDR = b"\0\1\0\0"
IMAGE, POSE, STOP = "/camera/image", "/pose", "/emergency_stop"


class Row(NamedTuple):
    """What one right permits: a node of this type and topic, or a message that names this manager."""

    right: Right
    node_type: int = 0
    topic: str = ""
    manager: str = ""


TO_ROBOTS = [
    Row("see", NodeType.SUBSCRIBER, IMAGE),
    Row("command", NodeType.PUBLISHER, IMAGE),
    Row("call", NodeType.CLIENT, IMAGE),
    Row("serve", NodeType.SERVICE, IMAGE),
    Row("act", NodeType.ACTION, IMAGE),
    Row("stop", NodeType.PUBLISHER, STOP),
    Row("see", manager="RobotStatus"),
    Row("see", manager="FunctionalityGetter"),
    Row("command", manager="RobotControl"),
    Row("ask", manager="SomebodysOwn"),
    Row("ask"),
]
OTHERWISE: set[Right] = {"send", "broadcast", "robot", "record"}
"""Below; to record is what the web port is asked for, in tests of its own."""
ALONE: set[Right] = {"broadcast", "robot", "record"}
"""What a token has only by itself: all robots, or that it is a robot's."""


class Heard:
    """What robots 1 and 2, of groups 3 and 4, are asked and told."""

    def __init__(self, robots: list[Agent]) -> None:
        self.of: dict[int, list[str]] = {robot.id: [] for robot in robots}
        for robot in robots:
            robot.on_message(lambda message, number=robot.id: self.of[number].append(bytes(message.data[4:]).decode()))

            async def registered(call: Call, number: int = robot.id) -> bytes:
                node = decode_data(AddNode, call.data)
                self.of[number].append(f"{node.node_type} {node.tos_name}")
                return b""

            async def stops(call: Call, number: int = robot.id) -> bytes:
                self.of[number].append("stop")
                return b"{}"

            robot.serve("add_node", registered)
            robot.serve("stop", stops)


@pytest.fixture
async def robots(router: str) -> AsyncIterator[list[Agent]]:
    """Robots 1 and 2, the first in group 3, the second in group 4."""
    async with AsyncExitStack() as stack:
        yield [
            await stack.enter_async_context(join(ROS, id=number, group=2 + number, settings=patient(router)))
            for number in (1, 2)
        ]


@pytest.fixture
async def start_door(start_gateway: StartGateway, tmp_path: Path) -> StartDoor:
    """Starts gateways with all ports, on which nobody is let in without a token."""
    authority = Authority(tmp_path / "ca")
    certificate, key = map(str, authority.issue("gateway"))
    tokens = Tokens(tmp_path / "macs" / "tokens.json")

    async def start() -> Door:
        said = {"tokens_file": str(tokens.path), "certificate": certificate, "key": key, **NOBODY}
        gateway = await start_gateway(tls_port=0, web_port=0, **said)
        other = await start_gateway(web_port=0, **{**said, "web_host": "0.0.0.0"})
        return Door(gateway, other, str(authority.ca), tokens)

    return start


def all_but(*rights: Right) -> list[Right]:
    """The others, without what a token has only alone."""
    return [each for each in RIGHTS if each not in (*rights, *ALONE)]


Attempt = Callable[[str, list[int], list[int]], Awaitable[None]]


def attempt_of(headset: Headset, row: Row, topic: str) -> Attempt:
    """Try it, with a word that tells it from all others, at these robots and groups."""

    async def attempt(word: str, ids: list[int], groups: list[int]) -> None:
        data = CDR + word.encode()
        if not row.node_type:
            frame = frames.plain_data(headset.id, data, to_type=ROS, ids=ids, groups=groups, manager=row.manager)
            await headset.send_frame(frame)
            return
        node = NodeSpec(row.node_type, topic, "pkg/T")  # type: ignore[arg-type]
        await headset.send_frame(frames.registration(headset.id, node, ids, groups))
        if row.node_type != NodeType.SUBSCRIBER:
            await headset.send_frame(frames.node_data(headset.id, node, data, ids, groups))

    return attempt


def test_every_right_has_its_row() -> None:
    """None is added without its attempts."""
    assert {row.right for row in TO_ROBOTS} | OTHERWISE == set(RIGHTS)
    assert {row.node_type for row in TO_ROBOTS} - {0} == set(NodeType)


@pytest.mark.parametrize("port", PORTS)
async def test_what_robots_hear(start_door: StartDoor, robots: list[Agent], port: str) -> None:
    """Each row by id and by group at robot 1, and nothing at robot 2; neither without the right, nor by another topic,
    nor where somebody else is named as well."""
    door, heard = await start_door(), Heard(robots)
    for row in TO_ROBOTS:
        for books in heard.of.values():
            books.clear()
        name = f"{row.right}-{row.node_type or row.manager or 'plain'}"
        of = {"robots": [1], "groups": [3], "topics": ["/camera/**"]}
        may = door.tokens.make(f"may-{name}", may=[row.right], **of)
        may_not = door.tokens.make(f"not-{name}", may=all_but(row.right), **of)
        async with await door.come(port, may) as one, await door.come(port, may_not) as two:
            await until(lambda: door.know((ROS, 1), (ROS, 2)))
            right, without = attempt_of(one, row, row.topic), attempt_of(two, row, row.topic)
            await right("robot 2", [2], [])
            await right("both", [1, 2], [])
            await right("group 4", [], [4])
            await right("id and group 4", [1], [4])
            if row.topic == IMAGE:
                await attempt_of(one, row, POSE)("another topic", [1], [])
            await without("no right", [1], [])
            await without("no right, group", [], [3])
            await two.online(PATIENCE_S)  # what it said before has been judged
            await right("by id", [1], [])
            await right("by group", [], [3])
            registers = [f"{row.node_type} {row.topic}"] if row.node_type else []
            wanted = registers if row.node_type == NodeType.SUBSCRIBER else [*registers, "by id", "by group"]
            await until(lambda wanted=wanted: set(wanted) <= set(heard.of[1]))
            await one.online(PATIENCE_S)
            await asyncio.sleep(0.05)
            assert set(heard.of[1]) - {"stop"} == set(wanted), name
            assert heard.of[2] == [], name
            assert two.forbidden or two.waiting, "it is told"


@pytest.mark.parametrize("port", PORTS)
async def test_what_headsets_hear(start_door: StartDoor, port: str) -> None:
    """By id and by group with the right to send; without it, or in another group, nothing."""
    door = await start_door()
    of = {"robots": [1], "groups": [3]}
    may, may_not = (
        door.tokens.make("may", may=["send"], **of),
        door.tokens.make("not", may=all_but("send"), **of),
    )
    anybody = door.tokens.make("anybody", may=[], groups="any")
    async with (
        await door.come(port, may) as one,
        await door.come(port, may_not) as two,
        await door.come("plain", anybody, group=3) as three,
        await door.come("plain", anybody, group=4) as four,
    ):
        await until(lambda: door.know(*((UNITY, each.id) for each in (one, two, three, four))))
        for sender, word in ((two, b"no right"), (one, b"right")):
            await sender.send(word + b", group 4", to=UNITY, groups=[4])
            await sender.send(word + b", id and group 4", to=UNITY, ids=[three.id], groups=[4])
            await sender.send(word + b", by id", to=UNITY, ids=[three.id])
            await sender.send(word + b", by group", to=UNITY, groups=[3])
            await sender.online(PATIENCE_S)
        assert [(await three.receive(PATIENCE_S)).data for _ in range(2)] == [b"right, by id", b"right, by group"]
        await one.send(b"last", to=UNITY, ids=[four.id, three.id])
        assert (await four.receive(PATIENCE_S)).data == b"last"
        assert (await three.receive(PATIENCE_S)).data == b"last"
        assert len(two.forbidden) >= 1
        assert {told.kind for told in (*one.forbidden, *two.forbidden)} == {"not_permitted"}


@pytest.mark.parametrize("port", PORTS)
async def test_what_everybody_hears(start_door: StartDoor, robots: list[Agent], port: str) -> None:
    """With the right to broadcast, and with no other."""
    door, heard = await start_door(), Heard(robots)
    may = door.tokens.make("may", may=["broadcast"], robots="any")
    may_not = door.tokens.make("not", may=all_but(), robots="any", groups="any")
    async with await door.come(port, may) as one, await door.come(port, may_not) as two:
        await until(lambda: door.know((ROS, 1), (ROS, 2), (UNITY, one.id), (UNITY, two.id)))
        await two.send(CDR + b"no right", to=EVERYBODY)
        await two.online(PATIENCE_S)
        await one.send(CDR + b"right", to=EVERYBODY)
        await until(lambda: all("right" in each for each in heard.of.values()))
        await until(lambda: two.forbidden)
        assert heard.of == {1: ["right"], 2: ["right"]}


@pytest.mark.parametrize("port", PORTS)
async def test_who_joins_as_what(start_door: StartDoor, port: str) -> None:
    """As a robot with the right for it, and with all others as a headset; in a group that the token names, and in none
    that it does not."""
    door = await start_door()
    robot, headset = (
        door.tokens.make("robot", may=["robot"], groups=[3]),
        door.tokens.make("headset", may=all_but(), groups=[3]),
    )
    gateway = door.other if port == "web_tls" else door.gateway
    number, way = door.way(port)
    for token, let_in in ((robot, True), (headset, False)):
        stream = await open_stream("127.0.0.1", number, way)
        stream.write(encode_frame(management=encode_management(Configuration(ROS, 0, 3, token=token))))
        if let_in:
            await until(lambda: [each.peer.agent_type for each in gateway.agents.online()] == [ROS])
        else:
            while await stream.read():
                pass
        stream.abort()
        await until(lambda: not list(gateway.agents.online()))
    with pytest.raises((Refused, Unreachable)):
        async with await door.come(port, robot) as other:
            await other.online(PATIENCE_S)
    async with await door.come(port, headset, group=3):
        await until(lambda: [each.peer.group for each in gateway.agents.online()] == [3])
    with pytest.raises(Refused, match="group 4 is not among the groups of this token"):
        await door.come(port, headset, group=4)
    await until(lambda: not list(gateway.agents.online()))
    stream = await open_stream("127.0.0.1", number, way)
    stream.write(frames.configuration(0, 4, 0, 1, headset))
    await until(lambda: [each.peer.group for each in gateway.agents.online()] == [0])
    stream.abort()
