"""`macs headset` as its own process against a real gateway, a real router and a robot made of Python."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

import macs_zenoh
from bridge.gateway import Gateway
from bridge.settings import GatewaySettings
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.messages import (
    AddNode,
    Functionality,
    FunctionalityRequest,
    Metadata,
    NodeType,
    RemoveNode,
    StreamData,
    decode_data,
    encode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams
from macs_zenoh.typed import Types, request_of, response_of
from tests.support.forks import Forked, started
from tests.support.waiting import PATIENCE_S, until

SET_BOOL = "std_srvs/SetBool"
STRING = "std_msgs/String"
TYPES = Types()


class EchoRobot:
    """Robot 1: streams every command back to the subscribers of its topic, and answers every request."""

    def __init__(self, agent: macs_zenoh.Agent) -> None:
        self.agent = agent
        self.nodes: dict[tuple[int, str], dict[int, AddNode]] = {}
        self.answers: asyncio.Queue[bytes] = asyncio.Queue()
        self.offers: Functionality | None = None
        """What it says that it has; None: it does not answer."""
        self.asked = 0
        self._changed = asyncio.Event()
        agent.serve("add_node", self._add)
        agent.serve("remove_node", self._remove)

    async def run(self) -> None:
        """Take messages for ever."""
        async for message in self.agent:
            metadata = message.metadata
            if metadata.node_type == NodeType.PUBLISHER:
                self.stream(metadata.node_name, metadata.data_exchange_type, message.data)
            elif metadata.node_type == NodeType.CLIENT:
                asked = TYPES.deserialize(request_of(metadata.data_exchange_type), message.data)
                response = {"success": asked["data"], "message": f"asked by {message.sender_id}"}
                data = TYPES.serialize(response_of(metadata.data_exchange_type), response)
                self.agent.send(data, to="unity", ids=[message.sender_id], metadata=metadata)
            elif metadata.node_type == NodeType.SERVICE:
                self.answers.put_nowait(message.data)
            elif metadata.message_manager == FunctionalityRequest.manager:
                self.asked += 1
                if self.offers is not None:
                    answer = Metadata(request_id=metadata.request_id)
                    self.agent.send(encode_data(self.offers), to="unity", ids=[message.sender_id], metadata=answer)

    def stream(self, node: str, data_type: str, cdr: bytes) -> None:
        """Put topic data for everybody who registered."""
        registrants = self.nodes.get((NodeType.SUBSCRIBER, node), {})
        metadata = Metadata(1, self.agent.id, 0, StreamData.manager, NodeType.SUBSCRIBER, node, data_type)
        management = encode_management(StreamData({"2": sorted(registrants)}))
        message = encode_message(metadata.encode(), cdr)
        Streams(self.agent).publish(node, encode_frame(1, management=management, message=message))

    async def registered(self, kind: NodeType, node: str, count: int = 1) -> list[int]:
        """Wait until so many headsets are registered on a node; their ids."""

        async def wait() -> list[int]:
            while len(ids := sorted(self.nodes.get((kind, node), {}))) != count:
                self._changed.clear()
                await self._changed.wait()
            return ids

        return await asyncio.wait_for(wait(), PATIENCE_S)

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(AddNode, call.data)
        self.nodes.setdefault((node.node_type, node.node_name), {})[node.registrant_agent_id] = node
        self._changed.set()
        return b""

    async def _remove(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(RemoveNode, call.data)
        self.nodes.get((node.node_type, node.node_name), {}).pop(node.registrant_agent_id, None)
        self._changed.set()
        return b""


class Process:
    """One `macs headset …` with its lines."""

    def __init__(self, process: asyncio.subprocess.Process | Forked) -> None:
        self.process = process
        self.told = ""
        """What was read of its log so far."""

    async def line(self) -> dict[str, Any]:
        """Its next line on stdout."""
        assert self.process.stdout is not None
        text = await asyncio.wait_for(self.process.stdout.readline(), PATIENCE_S)
        assert text, (await self.process.communicate())[1].decode()
        value: dict[str, Any] = json.loads(text)
        return value

    def say(self, *lines: str) -> None:
        """Write lines to its stdin."""
        assert self.process.stdin is not None
        self.process.stdin.write("".join(f"{line}\n" for line in lines).encode())

    async def tells(self, words: str) -> None:
        """Wait until its log has these words."""
        assert self.process.stderr is not None
        while words not in self.told:
            text = await asyncio.wait_for(self.process.stderr.readline(), PATIENCE_S)
            assert text, self.told
            self.told += text.decode()

    def interrupt(self) -> None:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)

    async def end(self) -> tuple[int, list[dict[str, Any]], str]:
        """Close its stdin; its exit code, the lines not read yet, and its log."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        out, log = await asyncio.wait_for(self.process.communicate(), PATIENCE_S)
        lines = [json.loads(line) for line in out.splitlines()]
        return self.process.returncode or 0, lines, self.told + log.decode()


Start = Callable[..., Any]


@pytest.fixture
def mesh_settings(router: str) -> MeshSettings:
    """How to reach a router that runs here."""
    return MeshSettings(connect=[router])


@contextlib.asynccontextmanager
async def running_gateway(settings: MeshSettings, port: int = 0) -> AsyncIterator[Gateway]:
    async with await Mesh.open(settings) as mesh:
        gateway = Gateway(mesh, GatewaySettings(port=port))
        await gateway.start()
        try:
            yield gateway
        finally:
            await gateway.close()


@pytest.fixture
async def gateway(mesh_settings: MeshSettings) -> AsyncIterator[Gateway]:
    async with running_gateway(mesh_settings) as gateway:
        yield gateway


@pytest.fixture
async def robot(mesh_settings: MeshSettings, gateway: Gateway) -> AsyncIterator[EchoRobot]:
    """Robot 1, seen by the gateway."""
    async with macs_zenoh.join("ros", id=1, settings=mesh_settings) as agent:
        robot = EchoRobot(agent)
        running = asyncio.create_task(robot.run())
        while (1, 1) not in gateway.directory:
            await asyncio.sleep(0.01)
        yield robot
        running.cancel()


@pytest.fixture
async def start(gateway: Gateway) -> AsyncIterator[Start]:
    """Start `macs headset` with these words, by default at the gateway."""
    running: list[asyncio.subprocess.Process | Forked] = []

    async def start(*words: str, port: int | None = None, options: tuple[str, ...] = ()) -> Process:
        target = f"127.0.0.1:{port or gateway.port}"
        command = [sys.executable, "-m", "bridge", "headset", target, *options, *words]
        process = await started(command, os.environ, asyncio.subprocess.PIPE)
        running.append(process)
        return Process(process)

    yield start
    for process in running:
        if process.returncode is None:
            process.kill()
            await process.communicate()


async def test_online(start: Start, robot: EchoRobot) -> None:
    """`online` prints the own id and who is there."""
    code, lines, log = await (await start("online")).end()
    assert code == 0, log
    assert lines == [{"id": lines[0]["id"], "ros": [1], "unity": [lines[0]["id"]]}]


async def test_a_topic_is_published_and_received(start: Start, robot: EchoRobot) -> None:
    """What one headset publishes, typed from JSON, another one receives typed, in order, each message once."""
    subscriber = await start("sub", "/talk", "std_msgs/String", "--count", "3", "--timeout", "90")
    await robot.registered(NodeType.SUBSCRIBER, "nd__talk")
    publisher = await start("pub", "/talk", "std_msgs/String", '{"data": "$i"}', "--count", "3", "--settle", "0.2")
    code, lines, log = await publisher.end()
    assert (code, lines) == (0, [{"topic": "/talk", "published": 3}]), log
    code, lines, log = await subscriber.end()
    assert code == 0, log
    assert lines == [{"topic": "/talk", "from": 1, "message": {"data": str(number)}} for number in range(3)]


async def test_sizes_need_no_type(start: Start, robot: EchoRobot) -> None:
    """With --raw any type is received, as sizes."""
    subscriber = await start("sub", "/x", "my_msgs/Unknown", "--raw", "--count", "1")
    await robot.registered(NodeType.SUBSCRIBER, "nd__x")
    robot.stream("nd__x", "my_msgs/Unknown", bytes(5000))
    assert (await subscriber.end())[:2] == (0, [{"topic": "/x", "from": 1, "bytes": 5000}])


async def test_a_service_is_called(start: Start, robot: EchoRobot) -> None:
    """`call` prints the typed response of the only robot."""
    code, lines, log = await (await start("call", "/set", SET_BOOL, '{"data": true}')).end()
    assert code == 0, log
    assert lines[0]["response"]["success"] is True
    assert (lines[0]["service"], lines[0]["from"]) == ("/set", 1)


async def test_a_service_is_served(start: Start, robot: EchoRobot) -> None:
    """`serve` answers a robot's request and prints it."""
    process = await start("serve", "/ask", SET_BOOL, '{"success": true, "message": "done"}', "--count", "1")
    (headset_id,) = await robot.registered(NodeType.SERVICE, "nd__ask")
    request = TYPES.serialize(request_of(SET_BOOL), {"data": True})
    metadata = Metadata(request_id=5, node_type=NodeType.SERVICE, node_name="nd__ask", data_exchange_type=SET_BOOL)
    robot.agent.send(request, to="unity", ids=[headset_id], metadata=metadata)
    response = await asyncio.wait_for(robot.answers.get(), PATIENCE_S)
    assert TYPES.deserialize(response_of(SET_BOOL), response) == {"success": True, "message": "done"}
    code, lines, log = await process.end()
    assert (code, lines) == (0, [{"service": "/ask", "from": 1, "request": {"data": True}}]), log


async def test_headsets_reach_each_other(start: Start, gateway: Gateway, mesh_settings: MeshSettings) -> None:
    """By id, by group and by broadcast, a headset on another gateway gets each message exactly once."""
    async with running_gateway(mesh_settings) as other:
        listener = await start("run", "-", options=("--group", "3"))
        connected = await listener.line()
        assert connected["group"] == 3
        listener.say("listen --from unity")
        assert await listener.line() == {"started": "listen"}
        sender = await start("run", "-", port=other.port)
        me = (await sender.line())["connected"]
        while connected["connected"] not in (await _online(sender))["unity"]:
            await asyncio.sleep(0.05)
        sender.say(f"send one --to unity --ids {connected['connected']}")
        sender.say("send two --to unity --groups 3", "send three --to all", "send four --to unity --groups 9")
        sender.say(f"send five --to unity --ids {connected['connected']} --groups 3")
        code, lines, log = await sender.end()
        assert (code, len(lines)) == (0, 5), log
        heard = [await listener.line() for _ in range(4)]
        assert {line["text"] for line in heard} == {"one", "two", "three", "five"}
        assert all(line["from"] == {"type": "unity", "id": me} for line in heard)
        assert (await listener.end())[:2] == (0, [])


async def _online(process: Process) -> dict[str, Any]:
    process.say("online")
    return await process.line()


async def test_a_script_uses_one_connection(start: Start, robot: EchoRobot) -> None:
    """A script subscribes, publishes, waits and calls as one headset; its lines come in order."""
    process = await start("run", "-")
    headset_id = (await process.line())["connected"]
    process.say("# a comment", "", "sub /talk std_msgs/String --agents 1")
    assert await process.line() == {"started": "sub", "name": "/talk"}
    assert await robot.registered(NodeType.SUBSCRIBER, "nd__talk") == [headset_id]
    process.say('pub /talk std_msgs/String \'{"data": "hello"}\' --agents 1 --settle 0.2 --count 2')
    process.say("wait /talk --count 2 --timeout 10", "unsub /talk")
    process.say(f"call /set {SET_BOOL} '{{\"data\": true}}' --agent 1")
    code, lines, log = await process.end()
    assert code == 0, log
    received = {"topic": "/talk", "from": 1, "message": {"data": "hello"}}
    assert [line for line in lines if line == received] == [received] * 2
    rest = [line for line in lines if line != received]
    assert rest[:3] == [{"topic": "/talk", "published": 2}, {"done": "wait"}, {"done": "unsub"}]
    assert rest[3]["response"]["message"] == f"asked by {headset_id}"


async def test_a_failing_line_ends_a_script(start: Start, robot: EchoRobot, tmp_path: Path) -> None:
    """A script stops at a line that fails and says which; with --keep-going it goes on, and fails in the end."""
    script = tmp_path / "script.txt"
    script.write_text("online\nwait /nothing --timeout 0.01\nonline\n")
    code, lines, _ = await (await start("run", str(script))).end()
    assert (code, len(lines)) == (1, 3)
    assert lines[2]["error"].startswith("line 2: ")
    script.write_text("fly\nonline\n")
    code, lines, _ = await (await start("run", "--keep-going", str(script))).end()
    assert code == 2
    assert "invalid choice" in lines[1]["error"]
    assert lines[2]["ros"] == [1]


async def test_a_stopped_subscription_ends_well(start: Start, robot: EchoRobot, gateway: Gateway) -> None:
    """Ctrl-C on a verb without an end is its end: exit code 0, and the headset is offline at once."""
    process = await start("sub", "/talk", "std_msgs/String")
    (headset_id,) = await robot.registered(NodeType.SUBSCRIBER, "nd__talk")
    gone = asyncio.Event()
    robot.agent.on_presence(lambda who, here: gone.set() if who.key == (2, headset_id) and not here else None)
    process.interrupt()
    code, lines, log = await process.end()
    assert (code, lines) == (0, []), log
    assert "Traceback" not in log
    await asyncio.wait_for(gone.wait(), PATIENCE_S)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
async def test_a_stopped_service_ends_well(start: Start, robot: EchoRobot, number: signal.Signals) -> None:
    """A signal ends `serve`, too, with exit code 0 and nothing in its log but its end."""
    process = await start("serve", "/ask", SET_BOOL, "{}")
    await robot.registered(NodeType.SERVICE, "nd__ask")
    process.process.send_signal(number)
    code, lines, log = await process.end()
    assert (code, lines) == (0, []), log
    assert [line.split(":")[2].split()[-1] for line in log.splitlines()] == ["macs.headset"] * len(log.splitlines()), (
        log
    )


async def test_an_interrupted_count_is_130(start: Start, robot: EchoRobot) -> None:
    """Ctrl-C before a verb has done what was asked is exit code 130."""
    process = await start("sub", "/talk", "std_msgs/String", "--count", "5")
    await robot.registered(NodeType.SUBSCRIBER, "nd__talk")
    process.interrupt()
    assert (await process.end())[0] == 130


async def test_too_few_messages_are_a_failure(start: Start, robot: EchoRobot) -> None:
    """Fewer messages than asked for within the time are exit code 1."""
    code, lines, _ = await (await start("sub", "/talk", "std_msgs/String", "--count", "1", "--timeout", "0.3")).end()
    assert (code, lines) == (1, [])


async def test_a_reader_that_leaves_ends_it(start: Start, robot: EchoRobot) -> None:
    """When the reader of stdout leaves, as `head` does, the headset ends without a traceback."""
    process = await start("sub", "/talk", "std_msgs/String")
    await robot.registered(NodeType.SUBSCRIBER, "nd__talk")
    process.process.stdout._transport.close()  # type: ignore[attr-defined]
    cdr = TYPES.serialize("std_msgs/String", {"data": "hello"})
    while process.process.returncode is None:
        robot.stream("nd__talk", "std_msgs/String", cdr)
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(process.process.wait(), 0.1)
    assert process.process.stderr is not None
    log = (await process.process.stderr.read()).decode()
    assert process.process.returncode == 1
    assert "Traceback" not in log


async def test_nobody_is_there(start: Start, unused_tcp_port: int) -> None:
    """Without a gateway, or without a robot to talk to, one line says so and the exit code is 1."""
    code, lines, log = await (await start("online", port=unused_tcp_port)).end()
    assert (code, lines) == (1, [])
    assert log.startswith(f"macs headset: 127.0.0.1:{unused_tcp_port} cannot be reached")
    code, lines, log = await (await start("sub", "/talk", "std_msgs/String")).end()
    assert (code, lines) == (1, [])
    assert "none is online" in log


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("pub", "/cmd_vel", "geometry_msgs/Twist", '{"linear": {"q": 1}}'), "linear.q: no such field"),
        (("pub", "/cmd_vel", "geometry_msgs/Twist", "{"), "is not JSON"),
        (("sub", "/talk", "std_msgs/Sting"), "no definition found"),
        (("call", "/set", SET_BOOL, '{"data": 1}'), "a bool was expected"),
        (("send", "hello", "--to", "unity"), "Give --ids or --groups"),
        (("send", "hello", "--ids", "3"), "--to all goes to everybody"),
    ],
)
async def test_wrong_values_are_wrong_usage(start: Start, words: tuple[str, ...], problem: str) -> None:
    """A value that does not fit its type is exit code 2 with one line that names the field."""
    code, lines, log = await (await start(*words)).end()
    assert (code, lines) == (2, [])
    assert problem in log
    assert "Traceback" not in log


async def test_a_subscription_survives_its_gateway(
    start: Start, robot: EchoRobot, gateway: Gateway, mesh_settings: MeshSettings
) -> None:
    """With --reconnect a subscription goes on when the gateway is restarted; without, it ends with exit code 1."""
    staying = await start("sub", "/talk", "std_msgs/String", "--count", "1", options=("--reconnect",))
    await robot.registered(NodeType.SUBSCRIBER, "nd__talk")
    leaving = await start("sub", "/talk", "std_msgs/String")
    await robot.registered(NodeType.SUBSCRIBER, "nd__talk", 2)
    port = gateway.port
    robot.nodes.clear()
    await gateway.close()
    code, _, log = await leaving.end()
    assert code == 1
    assert "the router closed the connection" in log
    async with running_gateway(mesh_settings, port):
        await robot.registered(NodeType.SUBSCRIBER, "nd__talk")
        robot.stream("nd__talk", "std_msgs/String", TYPES.serialize("std_msgs/String", {"data": "again"}))
        code, lines, log = await staying.end()
    assert (code, lines) == (0, [{"topic": "/talk", "from": 1, "message": {"data": "again"}}]), log


# --- hints ---

OFFERED = Functionality({"/cmd_vel": "geometry_msgs/msg/Twist"}, {"/chatter": "std_msgs/msg/String"})


@pytest.mark.parametrize("offers", [OFFERED, None])
@pytest.mark.parametrize("topic", ["/chatter", "/chater"])
async def test_who_hears_nothing_learns_why(
    start: Start, robot: EchoRobot, topic: str, offers: Functionality | None
) -> None:
    robot.offers = offers
    sub = await start("sub", topic, STRING)
    if wrong := topic == "/chater" and offers is not None:
        await sub.tells("robot 1 offers no publisher of /chater; did you mean /chatter?")
    else:
        await until(lambda: robot.asked)
        robot.stream(node_name(topic), STRING, TYPES.serialize(STRING, {"data": "behind the answer"}))
        await sub.line()
    sub.interrupt()
    code, _, log = await sub.end()
    assert (code, "offers no" in log, robot.asked) == (0, wrong, 1)


async def test_a_group_without_robots_is_told(start: Start, robot: EchoRobot) -> None:
    """Who subscribes by group and hears nothing is told that nobody may be in it."""
    sub = await start("sub", "/chatter", STRING, "--groups", "9")
    await sub.tells("nothing from group 9 yet")
    sub.interrupt()
    assert (await sub.end())[0] == 0
    pub = await start("pub", "/chatter", STRING, '{"data": "x"}', "--groups", "9", "--settle", "0")
    code, _, log = await pub.end()
    assert (code, "sent to all robots of group 9, if there are any" in log) == (0, True), log


async def test_who_hears_something_is_told_nothing(start: Start, robot: EchoRobot) -> None:
    robot.offers = OFFERED
    sub = await start("sub", "/talk", STRING, "--timeout", "3")
    await robot.registered(NodeType.SUBSCRIBER, node_name("/talk"))
    robot.stream(node_name("/talk"), STRING, TYPES.serialize(STRING, {"data": "here"}))
    code, _, log = await sub.end()
    assert (code, robot.asked, "offers no" in log) == (0, 0, False)


async def test_who_drives_nothing_is_told_once(start: Start, robot: EchoRobot) -> None:
    robot.offers = OFFERED
    script = await start("run", "-")
    for _ in range(3):
        script.say(f"pub /cmdvel {STRING} '{{}}'")
    code, _, log = await script.end()
    assert (code, robot.asked) == (1, 1)
    assert log.count("robot 1 offers no subscriber to /cmdvel; did you mean /cmd_vel?") == 1


# --- types that robots know ---

KNOWN = Functionality(
    {"/cmd_vel": "geometry_msgs/msg/Twist", "/talk": "std_msgs/msg/String"},
    {"/chatter": "std_msgs/msg/String", "/talk": "std_msgs/msg/String"},
    {"/set": "std_srvs/srv/SetBool"},
)


async def test_a_type_that_robots_offer_need_not_be_named(start: Start, robot: EchoRobot) -> None:
    """`sub`, `pub` and `call` take the type of a topic or service from the robots; options may stand anywhere."""
    robot.offers = KNOWN
    subscriber = await start("sub", "/talk", "--count", "2", "--timeout", "90")
    await robot.registered(NodeType.SUBSCRIBER, "nd__talk")
    for words in (["/talk", '{"data": "a"}', "--settle", "0.2"], ["/talk", "--settle", "0.2", '{"data": "a"}']):
        code, lines, log = await (await start("pub", *words)).end()
        assert (code, lines) == (0, [{"topic": "/talk", "published": 1}]), log
    code, lines, log = await subscriber.end()
    assert (code, lines) == (0, [{"topic": "/talk", "from": 1, "message": {"data": "a"}}] * 2), log
    for words in (["/set", '{"data": true}'], ["set", '{"data": true}', "--agent", "1"]):
        code, lines, log = await (await start("call", *words)).end()
        assert (code, lines[0]["response"]["success"]) == (0, True), log


@pytest.mark.parametrize(
    ("words", "code", "reason"),
    [
        (["sub", "/chater"], 1, "no robot offers it; did you mean /chatter?"),
        (["call", "/other"], 1, "service /other cannot be reached: no robot offers it"),
        (["pub", "/talk"], 2, "the following arguments are required: [TYPE] JSON"),
        (["pub", "/talk", "std_msgs/String"], 2, "what to publish to /talk is missing"),
        (["pub", "/talk", "{"], 2, "is not JSON"),
        (["pub", "/talk", '{"data": 1}'], 2, "a string was expected"),
    ],
)
async def test_what_cannot_be_known_is_told(
    start: Start, robot: EchoRobot, words: list[str], code: int, reason: str
) -> None:
    """A name that no robot offers, and a message that is none, are told before anything is registered."""
    robot.offers = KNOWN
    ended, _, log = await (await start(*words)).end()
    assert (ended, reason in log) == (code, True), log
    assert not robot.nodes
