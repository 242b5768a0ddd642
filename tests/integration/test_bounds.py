"""What one agent says costs nobody else anything, whatever its size and whatever it names."""

from __future__ import annotations

import asyncio
import itertools
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import cache

import pytest

import macs_zenoh
from bridge.gateway.connection import Connection
from bridge.gateway.subscriptions import Subscriptions
from bridge.headset.client import Headset
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import (
    AddNode,
    Configuration,
    Metadata,
    NodeRefused,
    Registration,
    RemoveNode,
    decode_data,
    encode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message, split_message
from tests.support.gateways import answers, memory_bytes, site
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.waiting import PATIENCE_S, until


@cache
def many_keys() -> bytes:
    """30 MB of JSON, made when a test needs them."""
    return b"{%s}" % ",".join(f'"key{n}":0' for n in range(2_200_000)).encode()


def many_lists() -> bytes:
    """As many bytes of JSON in 10 million lists."""
    return b'{"messageManager":"OnlineAgentsGetter","x":[%s0]}' % (b"[]," * (10 << 20))


def registration(name: str, group: int = 0, robots: tuple[int, ...] = (), body: bytes | None = None) -> bytes:
    """A headset's registration on a topic, whatever the name."""
    node = encode_data(AddNode(2, 1, 1, name, "/x", "std_msgs/String")) if body is None else body
    management = Registration(1, 1, name if body is None else "nd_x", list(robots), [group] if group else [], "/x")
    metadata = Metadata(2, 1, message_manager=AddNode.manager).encode()
    return encode_frame(management=encode_management(management), message=encode_message(metadata, node))


class Raw:
    """A TCP agent that sends whatever it is told to."""

    def __init__(self, port: int, agent_type: int = 2, group: int = 0) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        self.decoder = MessageDecoder()
        self.messages: list[tuple[Metadata, bytes]] = []
        self.socket.sendall(encode_frame(management=encode_management(Configuration(agent_type, 0, group))))

    async def send(self, raw: bytes) -> None:
        """Send it all, in a thread."""
        await asyncio.to_thread(self.socket.sendall, raw)

    def read(self) -> list[tuple[Metadata, bytes]]:
        """All messages that have come so far."""
        self.socket.setblocking(False)
        with suppress(BlockingIOError):
            while data := self.socket.recv(1 << 16):
                for message in self.decoder.feed(data):
                    metadata, body = split_message(message)
                    self.messages.append((Metadata.decode(metadata), bytes(body)))
        self.socket.settimeout(PATIENCE_S)
        return self.messages

    def refusals(self) -> list[NodeRefused]:
        """Those that it was told."""
        return [
            decode_data(NodeRefused, data) for said, data in self.read() if said.message_manager == NodeRefused.manager
        ]


COSTLY: dict[str, Callable[[], bytes]] = {
    "metadata of 2.2 million keys": lambda: encode_frame(2, [1], message=encode_message(many_keys())),
    "management data of 2.2 million keys": lambda: encode_frame(management=many_keys()),
    "management data of 10 million lists": lambda: encode_frame(management=many_lists()),
    "a registration's node of 2.2 million keys": lambda: registration("nd_x", robots=(1,), body=many_keys()),
    "metadata beside management data": lambda: encode_frame(management=b"{}", message=encode_message(many_keys())),
}


@pytest.mark.parametrize("what", COSTLY)
async def test_a_costly_frame_costs_only_itself(what: str) -> None:
    """A frame of 30 MB of JSON is not parsed: the gateway answers others meanwhile, its memory comes back, and who
    sent it stays connected."""
    async with site() as (_, gateway), await Headset.connect("127.0.0.1", gateway.port) as neighbour:
        attacker = Raw(gateway.port)
        await answers(neighbour)
        before = memory_bytes(gateway.pid)
        await attacker.send(COSTLY[what]())
        await attacker.send(
            encode_frame(2, [neighbour.id], message=encode_message(Metadata(2, 0, 1, "Hello").encode()))
        )
        message = await asyncio.wait_for(neighbour.receive(), PATIENCE_S)
        assert message.metadata.message_manager == "Hello"
        await answers(neighbour)
        await until(lambda: memory_bytes(gateway.pid) - before < 48 << 20)
        attacker.socket.close()


async def test_names_that_no_key_can_have(start_gateway: StartGateway, connect: Connect, router: str) -> None:
    """Registrations with a name of 70 000 characters, with none and with control characters are refused and told;
    headsets that come and register afterwards are served."""
    gateway = await start_gateway()
    attacker = Raw(gateway.port)
    for name in ("x" * 60_000, "", "a\nb", "\x1b[2J"):
        await attacker.send(registration(name, group=200, robots=(1,)))
    await until(lambda: len(attacker.refusals()) == 4)
    assert all(refused.reason for refused in attacker.refusals())
    async with macs_zenoh.join("ros", id=1, group=200, settings=patient(router)) as robot:

        async def accept(call: macs_zenoh.Call) -> bytes:
            return b""

        robot.serve("add_node", accept)
        neighbour = await connect(gateway)
        topic = await neighbour.subscribe("/chatter", "std_msgs/String", groups=[200])
        await until(lambda: any("nd__chatter" in key for key in gateway._delivery.streams))
        assert topic is not None
        await answers(neighbour)


async def test_topic_data_of_a_robot_under_any_name(start_gateway: StartGateway, connect: Connect) -> None:
    """A TCP robot that streams under a name of 70 000 characters, or one with control characters, loses those frames
    and nothing else; nobody else notices."""
    gateway = await start_gateway()
    robot = Raw(gateway.port, agent_type=1)
    neighbour = await connect(gateway)
    management = b'{"messageManager":"RosAgentSubscriberDataForwarder","destAgents":{"2":[1]}}'
    for name in ("x" * 70_000, "x" * 3000, "\n", "\U0001f916" * 255):
        metadata = Metadata(1, 1, 0, "m", 1, name, "std_msgs/String").encode()
        await robot.send(encode_frame(management=management, message=encode_message(metadata, b"data")))
    hello = Metadata(1, 1, 0, "Hello").encode()
    await robot.send(encode_frame(2, [neighbour.id], message=encode_message(hello)))
    message = await asyncio.wait_for(neighbour.receive(), PATIENCE_S)
    assert message.metadata.message_manager == "Hello"
    await answers(await connect(gateway))


async def test_what_waits_is_read_before_silence_is_judged(start_gateway: StartGateway) -> None:
    """A loop that was held up for longer than the silence that ends a connection cuts nobody who has spoken; who
    really is silent is cut."""
    gateway = await start_gateway(idle_timeout_s=2.0, handshake_timeout_s=2.5)
    with ExitStack() as stack:
        agents = [Raw(gateway.port) for _ in range(20)]
        late = [socket.create_connection(("127.0.0.1", gateway.port)) for _ in range(20)]
        for agent in agents:
            stack.callback(agent.socket.close)
        for one in late:
            stack.callback(one.close)
        await until(lambda: len(gateway.agents) == 40)
        await until(lambda: len(list(gateway.agents.online())) == 20)
        said = encode_frame(management=b'{"messageManager":"HeartbeatHandler"}')
        big = encode_frame(2, [1], message=encode_message(Metadata(2, 0).encode(), bytes(300_000)))
        for agent in agents:
            agent.socket.sendall(big + said)
        for one in late:
            one.sendall(encode_frame(management=encode_management(Configuration(2, 0))))
        time.sleep(4)  # nothing else runs here, which is the point
        online = []
        for _ in range(30):  # within the silence that is allowed from now on
            await asyncio.sleep(0.01)
            online.append(len(list(gateway.agents.online())))
        assert max(online) == 40
        await until(lambda: not len(gateway.agents))


async def test_half_frames_are_not_kept_for_ever(start_gateway: StartGateway, connect: Connect) -> None:
    """Who begins a frame and sends a byte of it now and then is cut; who sends a large one slowly is not."""
    gateway = await start_gateway()
    gateway._limits = gateway._limits._replace(partial_window_s=1.0, partial_bytes_per_s=10_000)
    neighbour = await connect(gateway)
    attacker, slow = Raw(gateway.port), Raw(gateway.port)
    await attacker.send(MACS.pack(2, [1], [], 0, 30 << 20) + bytes(1 << 20))
    big = encode_frame(2, [neighbour.id], message=encode_message(Metadata(2, 0, 0, "Big").encode(), bytes(600_000)))

    async def trickle() -> None:
        with suppress(OSError):
            while True:
                await attacker.send(b"\0")
                await asyncio.sleep(0.1)

    trickling = asyncio.create_task(trickle())
    for at in range(0, len(big), 100_000):
        await slow.send(big[at : at + 100_000])
        await asyncio.sleep(0.5)
    while (message := await asyncio.wait_for(neighbour.receive(), PATIENCE_S)).metadata.message_manager != "Big":
        pass
    assert len(message.data) == 600_000
    await until(lambda: gateway.drops["unfinished_frame"] == 1)
    trickling.cancel()
    await answers(neighbour)
    slow.socket.close()
    attacker.socket.close()


async def test_a_fault_of_ours_is_contained(
    start_gateway: StartGateway, connect: Connect, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An exception that nobody thought of, in the work for one agent, cuts neither it nor anybody else; it is counted
    for the agent whose value it was."""
    gateway = await start_gateway()
    attacker = Raw(gateway.port)
    await until(lambda: len(list(gateway.agents.online())) == 1)
    real, asked = gateway._roll.answer, itertools.count()

    def broken(connection: Connection) -> bytes:
        if next(asked) < 3:
            raise ZeroDivisionError
        return real(connection)

    monkeypatch.setattr(gateway._roll, "answer", broken)
    question = encode_management(macs_zenoh.protocol.messages.OnlineRequest(2, 1))
    raw = encode_frame(management=question, message=encode_message(Metadata(request_id=666).encode()))
    await attacker.send(raw * 3 + raw.replace(b"666", b"667"))
    await until(lambda: any(said.request_id == 667 for said, _ in attacker.read()))
    await answers(await connect(gateway))
    (connection,) = [one for one in gateway.agents.online() if one.drops["failed"]]
    assert connection.drops["failed"] == 3
    assert sum("logged once, counted as failed" in record.getMessage() for record in caplog.records) == 1
    attacker.socket.close()


async def test_destinations_that_are_made_up_cost_nothing(start_gateway: StartGateway, connect: Connect) -> None:
    """A megabyte that names 60 000 destinations leaves no publisher behind, and is told in the log; a neighbour is
    answered in the middle of it, and who is there is reached by such a frame."""
    gateway = await start_gateway()
    neighbour, attacker = await connect(gateway), Raw(gateway.port)
    hello = encode_message(Metadata(2, 0, 0, "Hello").encode())
    frames = [
        encode_frame(2, range(first, first + 10), range(1, 11), message=hello) for first in range(5000, 65_000, 10)
    ]
    sending = asyncio.create_task(attacker.send(b"".join(frames)))
    for _ in range(10):
        await answers(neighbour)
    await sending
    await attacker.send(encode_frame(2, [neighbour.id, 70], message=hello))
    message = await asyncio.wait_for(neighbour.receive(), PATIENCE_S)
    assert message.metadata.message_manager == "Hello"
    outlets = sum(map(len, gateway.mesh._outgoing._outlets.values()))
    assert outlets < 200
    (connection,) = [one for one in gateway.agents.online() if one.drops["too_many_strangers"]]
    assert connection.drops["too_many_strangers"] > 50_000


async def test_keys_that_are_used_again_get_a_publisher(start_gateway: StartGateway, connect: Connect) -> None:
    """Messages to the same agent come in order, whether its key has a publisher yet or not."""
    gateway = await start_gateway()
    sender, receiver = await connect(gateway), await connect(gateway)
    for number in range(20):
        await sender.send(str(number).encode(), to=2, ids=[receiver.id], manager="Greeting")
        if number < 4:
            await answers(sender)
    found = [int((await asyncio.wait_for(receiver.receive(), PATIENCE_S)).data) for _ in range(20)]
    assert found == list(range(20))
    assert any(
        f"/{receiver.id}/unity/" in key for outlets in gateway.mesh._outgoing._outlets.values() for key in outlets
    )


def toggled(topic: str) -> bytes:
    """A registration on a topic of robot 7, and its end."""
    nodes = AddNode(2, 1, 1, node_name(topic), topic, "std_msgs/String"), RemoveNode(2, 1, 1, node_name(topic))
    management = encode_management(Registration(1, 1, node_name(topic), [7], [], topic))
    said = [encode_message(Metadata(2, 1, message_manager=node.manager).encode(), encode_data(node)) for node in nodes]
    return b"".join(encode_frame(management=management, message=message) for message in said)


async def test_who_registers_and_leaves_again_and_again_declares_once(
    start_gateway: StartGateway, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To declare what a topic needs costs everybody on the mesh, so it stays for a moment when nobody wants it any
    more, of a few topics at one time; then it ends."""
    monkeypatch.setattr(Subscriptions, "LINGERING", 8)
    gateway = await start_gateway()
    declared: list[str] = []
    subscribe = gateway.mesh.subscribe
    monkeypatch.setattr(
        gateway.mesh, "subscribe", lambda key, *a, **k: (declared.append(key), subscribe(key, *a, **k))[1]
    )
    async with macs_zenoh.join("ros", id=7, settings=patient(router)):
        await until(lambda: (1, 7) in gateway.directory)
        attacker, before = Raw(gateway.port), set(gateway._subscriptions._by_key)

        def listening() -> set[str]:
            return set(gateway._subscriptions._by_key) - before

        await attacker.send(toggled("/again") * 50)
        await until(lambda: len(declared) == 1 and not listening())
        assert len(declared) == 1
        await attacker.send(b"".join(toggled(f"/{number}") for number in range(30)))
        await until(lambda: len(declared) > 1)  # of some, it has left again before it was their turn
        assert len(listening()) <= 9
        await until(lambda: not listening())
        assert len(set(declared)) == len(declared)
        attacker.socket.close()
