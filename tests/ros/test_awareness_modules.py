"""The helpers for modules on real rclpy: the client, the afferent with its file, and gateways that come and go."""

from __future__ import annotations

import array
import asyncio
import signal
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from as2_ca_msgs.msg import InterAgentMessage, LocalGenericMessage
from as2_ca_msgs.srv import RegisterModule
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String

from bridge.awareness.afferent import CONFIG_FILE, QUEUE, GatewayClientAfferent, Mode
from bridge.awareness.client import GatewayClient, Module
from bridge.awareness.node import SERVICE_QOS, UNDELIVERED_TOPIC
from tests.support.programs import Program, free_port
from tests.support.ros_peer import Peer
from tests.support.waiting import get, until

TOPIC_ONLY = ("awareness", "--transport", "topic", "--name", "drone0")


@pytest.fixture
async def gateway(domain: int) -> AsyncIterator[Program]:
    """A gateway of one robot, as a process; with the plain topic it needs no router."""
    async with Program(*TOPIC_ONLY, env={"ROS_DOMAIN_ID": str(domain)}) as program:
        yield program


@pytest.fixture
async def client(peer: Peer) -> GatewayClient:
    """A client on a module's node."""
    return await peer.session.run(lambda: GatewayClient(peer.session.node))


async def fake_gateway(peer: Peer, answers: dict[str, str] | None = None) -> list[str]:
    """A service register_module that answers as told, by default as it should; the types asked for."""
    asked: list[str] = []

    def answer(request: Any, response: Any) -> Any:
        asked.append(request.type)
        response.topic = f"/{request.type}_in" if answers is None else answers.get(request.type, "")
        return response

    await peer.session.run(
        lambda: peer.session.node.create_service(RegisterModule, "register_module", answer, qos_profile=SERVICE_QOS)
    )
    return asked


def local(agent: str, message_type: str, data: bytes) -> LocalGenericMessage:
    return LocalGenericMessage(agent=agent, type=message_type, data=array.array("B", data))


# -- the client ------------------------------------------------------------------------------------------------------


async def test_fifty_modules_register_at_once(gateway: Program, client: GatewayClient, peer: Peer) -> None:
    """All of 50 types that one node registers at the same moment have their topic, and the node's executor goes on."""
    modules = await peer.session.run(
        lambda: [client.register_module(String, f"type{n}", f"module{n}", lambda *_: None) for n in range(50)]
    )
    assert await peer.session.run(lambda: "still spinning") == "still spinning"
    await until(lambda: all(module.topic for module in modules))
    assert [module.topic for module in modules] == [f"/type{n}_in" for n in range(50)]
    assert client.get_subscriber_count() == 50
    await peer.session.run(client.clear)
    assert client.get_subscriber_count() == 0


async def test_a_module_registers_inside_a_callback(gateway: Program, client: GatewayClient, peer: Peer) -> None:
    """A registration made in a callback of the only executor thread is answered; nothing deadlocks."""
    made: list[Module] = []

    def callback(_message: String) -> None:
        made.append(client.register_module(String, "inner", "inside", lambda *_: None))

    await peer.session.run(lambda: peer.session.node.create_subscription(String, "/begin", callback, 10))
    publisher = await peer.publisher(String, "/begin", matched=1)
    publisher.publish(String())
    await until(lambda: made and made[0].topic == "/inner_in")
    assert await asyncio.to_thread(made[0].wait, 1)


async def test_an_invalid_type_is_refused(gateway: Program, client: GatewayClient, peer: Peer) -> None:
    """The module learns that its type is not valid; others are registered."""
    bad, good = await peer.session.run(
        lambda: [client.register_module(String, name, "m", lambda *_: None) for name in ("not valid", "valid")]
    )
    assert not await asyncio.to_thread(bad.wait, 10)
    assert await asyncio.to_thread(good.wait, 10)
    assert (bad.refused, bad.topic, good.refused) == (True, "", False)
    assert client.get_subscriber_count() == 1


async def test_data_of_another_type_costs_one_message(client: GatewayClient, peer: Peer) -> None:
    """What does not deserialize is counted, and the next message is received."""
    await fake_gateway(peer)
    received: list[tuple[str, str]] = []
    module = await peer.session.run(
        lambda: client.register_module(
            String, "t", "m", lambda message, sender: received.append((message.data, sender))
        )
    )
    assert await asyncio.to_thread(module.wait, 10)
    publisher = await peer.publisher(LocalGenericMessage, "/t_in", matched=1)
    publisher.publish(local("a", "t", b"\x00\x01\x00\x00\xff\xff\xff\x7f"))
    publisher.publish(local("b", "t", b"\x00\x01\x00\x00\x03\x00\x00\x00ok\x00"))
    await until(lambda: received)
    assert received == [("ok", "b")]
    assert client.counters["bad_message"] == 1


async def test_messages_wait_for_a_gateway(client: GatewayClient, peer: Peer) -> None:
    """What is sent before a gateway is there waits for it, the oldest dropped above the limit; to several, each."""
    for number in range(GatewayClient.HELD + 5):
        client.send_data(b"%d" % number, "t")
    out = await peer.subscription(LocalGenericMessage, "gateway_out", 200)
    assert bytes((await get(out)).data) == b"5"
    await until(lambda: out.qsize() == GatewayClient.HELD - 1)
    assert client.counters == {"unsent": 5, "sent": GatewayClient.HELD}
    while not out.empty():
        out.get_nowait()
    client.send(String(data="x"), "t", to=["a", "b"])
    assert [(await get(out)).agent for _ in range(2)] == ["a", "b"]


async def test_what_was_sent_is_known_to_be_there(
    gateway: Program, client: GatewayClient, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gateway says so itself, and has passed on all of it then; nobody waits for the middleware to acknowledge,
    and whether the node's executor spins makes no difference."""
    passed = await peer.subscription(InterAgentMessage, "/agent_to_agent", 200)
    await until(lambda: (client.send_data(b"are you there?", "t"), passed.qsize())[1])
    monkeypatch.setattr(client._out, "wait_for_all_acked", lambda _: False)
    for spins in (True, False):
        for number in range(20):
            client.send_data(b"%d" % number, "t")
        wait = peer.session.run(lambda: client.flush(20)) if not spins else asyncio.to_thread(client.flush, 20)
        assert await wait
        while bytes((await get(passed)).data) != b"0":
            pass
        for number in range(1, 20):
            assert bytes((await get(passed)).data) == b"%d" % number
    assert "invalid" not in "".join(gateway.log)


async def test_a_gateway_that_does_not_answer_is_known_to_have_acknowledged(client: GatewayClient, peer: Peer) -> None:
    """Of as2_ca's gateway, which is asked nothing, and when nobody is there at all it is known, too."""
    client.send_data(b"x", "t")
    assert not await asyncio.to_thread(client.flush, 0.3)
    out = await peer.subscription(LocalGenericMessage, "gateway_out", 200)
    assert await asyncio.to_thread(client.flush, 20)
    assert bytes((await get(out)).data) == b"x"
    assert out.empty()


async def test_a_module_misses_its_gateway(
    client: GatewayClient, domain: int, caplog: pytest.LogCaptureFixture
) -> None:
    """A module without a gateway says so once, with the ROS domain in which it looks."""
    await until(lambda: "no gateway offers" in caplog.text)
    (said,) = [record.getMessage() for record in caplog.records if "no gateway offers" in record.getMessage()]
    assert f"/register_module in ROS domain {domain}" in said


async def test_what_is_not_delivered_is_logged(
    client: GatewayClient, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    """Without a callback for it, a message that reached nobody is in the module's log."""
    publisher = await peer.publisher(LocalGenericMessage, UNDELIVERED_TOPIC, matched=1)
    await peer.session.run(lambda: publisher.publish(local("drone9", "chatter", b"no such agent")))
    await until(lambda: "'chatter' to 'drone9' was not delivered: no such agent" in caplog.text)


async def test_an_answer_that_never_comes_is_asked_for_again(
    client: GatewayClient, peer: Peer, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway that dies while it is asked costs one request: the next gateway is asked."""
    monkeypatch.setattr("bridge.awareness.registrar.ANSWER_S", 0.3)
    silent = Peer(domain, "silent")
    stuck, go_on = threading.Event(), threading.Event()

    def never(request: Any, response: Any) -> Any:
        stuck.set()
        go_on.wait(20)
        return response

    await silent.session.run(lambda: silent.session.node.create_service(RegisterModule, "register_module", never))
    module = await peer.session.run(lambda: client.register_module(String, "t", "m", lambda *_: None))
    await until(stuck.is_set)
    other = Peer(domain, "other")
    await fake_gateway(other)
    await until(lambda: module.topic == "/t_in")
    go_on.set()
    for one in (silent, other):
        await asyncio.to_thread(one.session.close)


async def test_a_restarted_gateway_knows_its_modules_again(client: GatewayClient, peer: Peer, domain: int) -> None:
    """After kill -9 of the gateway and a new start, the module gets messages again without doing anything."""
    program = Program(*TOPIC_ONLY, env={"ROS_DOMAIN_ID": str(domain)})
    await program.start()
    try:
        module = await peer.session.run(lambda: client.register_module(String, "t", "m", lambda *_: None))
        assert await asyncio.to_thread(module.wait, 10)
        node = peer.session.node
        await until(lambda: node.count_publishers("/t_in") == 1)
        await program.stop(signal.SIGKILL)
        before = len(program.log)
        await program.start()
        await until(lambda: any("registered 't' on /t_in" in line for line in program.log[before:]))
        assert client.get_subscriber_count() == 1
    finally:
        await program.stop()


# -- the afferent ----------------------------------------------------------------------------------------------------


def written(path: Path, text: str) -> str:
    file = path / "client_modules.yaml"
    file.write_text(text, encoding="utf-8")
    return str(file)


GOOD = """
modules:
  - type: "perception"
    module_name: "drone0_perception"
  - type: "planning"
    module_name: "drone0_planning"
"""


@pytest.mark.parametrize(
    "text",
    ["modules: [", "{}", "modules: 5", "- a", "", "modules: []", "modules: [{type: 5, module_name: x}, {type: a}, 7]"],
)
async def test_a_file_of_no_use_configures_nothing(peer: Peer, tmp_path: Path, text: str) -> None:
    """Broken YAML, no list of modules, or only malformed entries: configure() is False."""
    await fake_gateway(peer)
    afferent = GatewayClientAfferent(peer.session.node, written(tmp_path, text))
    assert await asyncio.to_thread(afferent.configure) is False
    assert afferent.topics == []


@pytest.mark.parametrize("file", ["", "/nowhere/client_modules.yaml"])
async def test_without_a_file_nothing_is_configured(peer: Peer, file: str) -> None:
    """No file, by argument or by parameter: configure() is False."""
    assert GatewayClientAfferent(peer.session.node, file).configure() is False
    assert GatewayClientAfferent(peer.session.node).configure() is False


async def test_without_a_gateway_it_gives_up(peer: Peer, tmp_path: Path) -> None:
    """Without the service, configure() is False after the time it may wait."""
    afferent = GatewayClientAfferent(peer.session.node, written(tmp_path, GOOD), wait_s=0.3)
    assert await asyncio.to_thread(afferent.configure) is False


async def test_entries_are_skipped_one_by_one(
    peer: Peer, domain: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A malformed entry, a refusal and an answer that does not come skip their entry with a message, not the rest."""
    gateway = Peer(domain, "gateway")
    go_on = threading.Event()

    def answer(request: Any, response: Any) -> Any:
        if request.type == "slow":
            go_on.wait(20)
        response.topic = "" if request.type == "refused" else f"/{request.type}_in"
        return response

    await gateway.session.run(lambda: gateway.session.node.create_service(RegisterModule, "register_module", answer))
    lines = "".join(f"  - {{type: {name}, module_name: m}}\n" for name in ("refused", "good", "slow"))
    afferent = GatewayClientAfferent(
        peer.session.node, written(tmp_path, f"modules:\n  - {{type: 5}}\n{lines}"), wait_s=1.0
    )
    try:
        assert await asyncio.to_thread(afferent.configure) is True
    finally:
        go_on.set()
        await asyncio.to_thread(gateway.session.close)
    assert afferent.topics == ["/good_in"]
    for text in ("entry 0 is not", "refuses 'refused'", "no answer for 'slow'"):
        assert text in caplog.text


async def test_both_modes(gateway: Program, peer: Peer, tmp_path: Path) -> None:
    """From the parameter's file, in a callback of the node's own executor; one input by callback, one on demand.

    On demand, the newest of too many messages are kept, in order.
    """
    node = peer.session.node
    file = written(tmp_path, GOOD)

    def configure() -> tuple[GatewayClientAfferent, bool]:
        node.declare_parameter(CONFIG_FILE, file)
        afferent = GatewayClientAfferent(node)
        return afferent, afferent.configure()

    afferent, configured = await peer.session.run(configure)  # in the executor's thread: it must not deadlock
    assert (configured, afferent.topics) == (True, ["/perception_in", "/planning_in"])
    called: list[Any] = []
    assert afferent.set_mode(0, Mode.CALLBACK, called.append)
    assert not afferent.set_mode(2, Mode.ON_DEMAND)
    assert not afferent.set_mode(0, Mode.CALLBACK)
    assert afferent.set_mode(1, Mode.ON_DEMAND)
    assert (afferent.get_msg(1), afferent.get_msg(9)) == (None, None)

    publishers = [await peer.publisher(LocalGenericMessage, topic, 200, matched=1) for topic in afferent.topics]
    publishers[0].publish(local("a", "perception", b"x"))
    await until(lambda: called)
    assert (called[0].agent, called[0].type, bytes(called[0].data)) == ("a", "perception", b"x")
    for number in range(QUEUE + 5):
        publishers[1].publish(local("a", "planning", b"%d" % number))
        await until(lambda number=number: bytes(last(afferent).data) == b"%d" % number)
    assert [bytes(afferent.get_msg(1).data) for _ in range(QUEUE)] == [b"%d" % n for n in range(5, QUEUE + 5)]
    assert afferent.get_msg(1) is None
    await peer.session.run(afferent.close)


def last(afferent: GatewayClientAfferent) -> Any:
    """The youngest waiting message, left where it is."""
    waiting = afferent._inputs[1]._waiting
    return waiting[-1] if waiting else LocalGenericMessage()


async def test_a_module_that_dies_is_noticed(gateway: Program, domain: int, peer: Peer) -> None:
    """A gateway with a dead module goes on: others register and are served."""
    other = Peer(domain, "other")
    dead = await other.session.run(lambda: GatewayClient(other.session.node))
    module = await other.session.run(lambda: dead.register_module(String, "t", "dead", lambda *_: None))
    assert await asyncio.to_thread(module.wait, 10)
    await asyncio.to_thread(other.session.close)
    await peer.sees("/t_in", publishers=1)
    client = await peer.session.run(lambda: GatewayClient(peer.session.node))
    again = await peer.session.run(lambda: client.register_module(String, "t", "alive", lambda *_: None))
    assert await asyncio.to_thread(again.wait, 10)
    assert again.topic == "/t_in"


async def test_a_client_works_on_any_executor(gateway: Program, domain: int) -> None:
    """On a plain node that the user spins, registration needs nothing but the spinning."""
    peer = Peer(domain, "plain")
    context = peer.session.context
    import rclpy

    node = await asyncio.to_thread(rclpy.create_node, "user", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    client = GatewayClient(node)
    module = client.register_module(String, "t", "m", lambda *_: None)

    def spin() -> None:
        for _ in range(1000):
            executor.spin_once(timeout_sec=0.05)
            if module.topic:
                return

    await asyncio.to_thread(spin)
    assert module.topic == "/t_in"
    client.close()
    executor.shutdown()
    node.destroy_node()
    await asyncio.to_thread(peer.session.close)
    assert free_port()
