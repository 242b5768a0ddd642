"""The gateway node on real rclpy and a real router: registration, forwarding, transports, lifecycle."""

from __future__ import annotations

import array
import asyncio
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack
from typing import Any

import pytest
from as2_ca_msgs.msg import InterAgentMessage, LocalGenericMessage
from as2_ca_msgs.srv import RegisterModule
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

import macs_zenoh
from bridge.awareness.client import GatewayClient
from bridge.awareness.gateway import Gateway, open_gateway
from bridge.awareness.node import LATCHED
from bridge.settings import AwarenessSettings, Settings
from macs_zenoh import awareness
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, UsageError
from tests.support.programs import ROOT, Program, free_port, macs
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, get, until

StartGateway = Callable[..., Awaitable[Gateway]]


@pytest.fixture
async def start(router: str, domain: int) -> AsyncIterator[StartGateway]:
    """Starts gateways, active unless told otherwise; keyword arguments are their settings."""
    async with AsyncExitStack() as stack:

        async def start(
            name: str = "drone0",
            *,
            in_domain: int = domain,
            ros_args: tuple[str, ...] = (),
            auto: bool = True,
            **more: Any,
        ) -> Gateway:
            settings = Settings(mesh=MeshSettings(connect=[router]), awareness=AwarenessSettings(name=name, **more))
            gateway = await stack.enter_async_context(
                open_gateway(settings, domain_id=in_domain, ros_args=["--ros-args", *ros_args] if ros_args else [])
            )
            if auto:
                await gateway.autostart()
            return gateway

        yield start


class Ground:
    """An agent without ROS, with everything it gets."""

    def __init__(self, owner: awareness.Awareness) -> None:
        self.owner = owner
        self.received: asyncio.Queue[awareness.Received] = asyncio.Queue()

    def takes(self, message_type: str) -> None:
        self.owner.register(message_type, self.received.put_nowait)


@pytest.fixture
async def ground(router: str) -> AsyncIterator[Ground]:
    """A ground station called ground."""
    async with (
        macs_zenoh.join("unity", connect=[router]) as agent,
        awareness.join(agent, "ground") as owner,
    ):
        yield Ground(owner)


async def call(peer: Peer, kind: type[Any], service: str, request: Any) -> Any:
    """Call a ROS service."""
    client = await peer.session.run(lambda: peer.session.node.create_client(kind, service))
    await until(client.service_is_ready)
    loop = asyncio.get_running_loop()
    done: asyncio.Future[Any] = loop.create_future()

    def ask() -> None:
        client.call_async(request).add_done_callback(
            lambda future: loop.call_soon_threadsafe(done.set_result, future.result())
        )

    await peer.session.run(ask)
    return await asyncio.wait_for(done, PATIENCE_S)


async def register(peer: Peer, message_type: str) -> str:
    """Ask the gateway for the topic of a type."""
    answer = await call(
        peer, RegisterModule, "/register_module", RegisterModule.Request(type=message_type, module_name="test")
    )
    return str(answer.topic)


def outgoing(agent: str, message_type: str, data: bytes) -> LocalGenericMessage:
    return LocalGenericMessage(agent=agent, type=message_type, data=array.array("B", data))


# -- upstream's own checks -----------------------------------------------------------------------------------------


async def test_registration_returns_the_topic_of_the_type(start: StartGateway, peer: Peer) -> None:
    """The answer is the fully qualified topic, the same each time; a namespace is that of the node."""
    await start()
    assert await register(peer, "test_type") == "/test_type_in"
    assert await register(peer, "test_type") == "/test_type_in"
    await start("other", ros_args=("-r", "__ns:=/arm"))
    answer = await call(peer, RegisterModule, "/arm/register_module", RegisterModule.Request(type="test_type"))
    assert answer.topic == "/arm/test_type_in"


async def test_type_and_data_are_forwarded_unchanged(start: StartGateway, peer: Peer, ground: Ground) -> None:
    """What an agent sends arrives on the type's topic with sender, type and data; what a module sends, there."""
    await start()
    topic = await register(peer, "test_type")
    received = await peer.subscription(LocalGenericMessage, topic)
    data = bytes(range(256))
    assert (await ground.owner.deliver("drone0", "test_type", data, deadline_s=PATIENCE_S)).value == "delivered"
    message = await get(received)
    assert (message.agent, message.type, bytes(message.data)) == ("ground", "test_type", data)

    ground.takes("back")
    out = await peer.publisher(LocalGenericMessage, "/gateway_out", matched=1)
    out.publish(outgoing("ground", "back", data))
    arrived = await get(ground.received)
    assert (arrived.sender, arrived.type, arrived.data) == ("drone0", "back", data)


async def test_a_string_arrives_in_the_typed_callback(start: StartGateway, peer: Peer, domain: int) -> None:
    """A String sent with one robot's client helper arrives in the other's callback as a String, with its sender."""
    await start("drone0")
    await start("drone1", in_domain=domain + 101)
    other = Peer(domain + 101)
    try:
        received: asyncio.Queue[tuple[str, str]] = asyncio.Queue()
        loop = asyncio.get_running_loop()
        client = await other.session.run(lambda: GatewayClient(other.session.node))
        await other.session.run(
            lambda: client.register_module(
                String,
                "words",
                "test",
                lambda message, sender: loop.call_soon_threadsafe(received.put_nowait, (message.data, sender)),
            )
        )
        sender = await peer.session.run(lambda: GatewayClient(peer.session.node))
        await until(lambda: sender.reachable("words") == ["drone1"])
        sender.send(String(data="hello"), "words", to="drone1")
        assert await get(received) == ("hello", "drone0")
        assert client.get_subscriber_count() == 1
        await other.session.run(client.clear)
        assert client.get_subscriber_count() == 0
        await until(lambda: not sender.reachable("words"))
    finally:
        other.session.close()


# -- what cannot be --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("message_type", ["", "two words", "ünïcode", "a-b", "a//b", "~x", "9lives", "x" * 300])
async def test_an_invalid_type_is_answered_with_no_topic(start: StartGateway, peer: Peer, message_type: str) -> None:
    """Types of which ROS makes no topic name are refused, and the next registration works."""
    await start()
    assert await register(peer, message_type) == ""
    assert await register(peer, "std_msgs/String") == "/std_msgs/String_in"


async def test_what_cannot_be_delivered_is_told(
    start: StartGateway, peer: Peer, ground: Ground, caplog: pytest.LogCaptureFixture
) -> None:
    """A module hears of each message without receiver, with its reason; the log has one line for each reason."""
    gateway = await start(max_bytes=1000)
    undelivered = await peer.subscription(LocalGenericMessage, "/gateway_undelivered")
    out = await peer.publisher(LocalGenericMessage, "/gateway_out", matched=1)
    await peer.sees("/gateway_undelivered", publishers=1, subscriptions=1)
    await until(lambda: gateway._link.knows("ground"))
    for agent, message_type, data in (
        ("nobody", "t", b""),
        ("nobody", "t", b""),
        ("ground", "t", b""),
        ("ground", "", b""),
        ("ground", "t", bytes(1001)),
        ("x" * 300, "t", b""),
        ("drone0", "t", b""),
    ):
        out.publish(outgoing(agent, message_type, data))
    told = [await get(undelivered) for _ in range(7)]
    assert [(m.agent[:6], m.type, bytes(m.data).decode()) for m in told] == [
        ("nobody", "t", "no such agent"),
        ("nobody", "t", "no such agent"),
        ("ground", "t", "not registered"),
        ("ground", "", "message type is empty"),
        ("ground", "t", "a message of 1001 bytes is above the limit of 1000"),
        ("xxxxxx", "t", "receiver has 300 characters, at most 200 are allowed"),
        ("drone0", "t", "to itself"),
    ]
    counted = {name: gateway.counters[name] for name in ("no_such_agent", "not_registered", "invalid", "too_large")}
    assert counted == {"no_such_agent": 2, "not_registered": 1, "invalid": 3, "too_large": 1}
    assert sum("no such agent" in record.getMessage() for record in caplog.records) == 1
    ground.takes("after")
    await until(lambda: gateway._link.others()["ground"]["takes"] == ["after"])
    out.publish(outgoing("ground", "after", b"x"))
    assert (await get(ground.received)).data == b"x"


@pytest.mark.parametrize(
    ("ros_args", "problem"),
    [
        (("-p", "agent_id:=''"), "the parameter agent_id is empty"),
        (("-p", "agent_id:=5"), "agent_id"),
        (("-p", "transport:=pigeon"), "'pigeon' is none of mesh, topic and both"),
        (("-p", "out_messages_topic:='a b'"), "ROS does not accept the parameters"),
    ],
)
async def test_wrong_parameters_are_an_error(start: StartGateway, ros_args: tuple[str, ...], problem: str) -> None:
    """An empty agent id, a wrong type, an unknown transport or a bad topic name end the start with one line."""
    with pytest.raises(ConfigError, match=problem):
        await start(ros_args=ros_args)


async def test_a_name_that_is_taken_is_an_error(start: StartGateway, ground: Ground, domain: int) -> None:
    """A second gateway of one name does not start, and the first goes on."""
    first = await start("drone0")
    with pytest.raises(UsageError, match="'drone0' is already on the mesh"):
        await start("drone0", in_domain=domain + 101)
    assert first.node.state == "active"
    await ground.owner.wait_for("drone0", timeout_s=PATIENCE_S)


async def test_ten_megabytes_arrive_whole(start: StartGateway, peer: Peer, ground: Ground) -> None:
    """10 MB go through the ROS topics and the mesh, in both directions, byte for byte."""
    await start()
    ground.takes("big")
    received = await peer.subscription(LocalGenericMessage, await register(peer, "big"))
    out = await peer.publisher(LocalGenericMessage, "/gateway_out", matched=1)
    await ground.owner.wait_for("drone0", "big", timeout_s=PATIENCE_S)
    data = bytes(range(256)) * 40_000
    out.publish(outgoing("ground", "big", data))
    assert (await get(ground.received, 30)).data == data
    assert ground.owner.send("drone0", "big", data).value == "sent"
    assert bytes((await get(received, 30)).data) == data


# -- transports ------------------------------------------------------------------------------------------------------


async def plain(peer: Peer) -> tuple[Any, asyncio.Queue[Any]]:
    """An as2_ca gateway of old: publishes and receives on the plain topic."""
    return (
        await peer.publisher(InterAgentMessage, "/agent_to_agent", matched=1),
        await peer.subscription(InterAgentMessage, "/agent_to_agent"),
    )


def inter(sender: str, receiver: str, message_type: str, data: bytes) -> InterAgentMessage:
    return InterAgentMessage(sender=sender, receiver=receiver, type=message_type, data=array.array("B", data))


async def test_the_plain_topic_interoperates(
    start: StartGateway, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    """With transport topic, a plain rclpy node and the modules exchange InterAgentMessage; no mesh is needed.

    Messages for others and the gateway's own are not delivered; an unregistered type is warned of once.
    """
    gateway = await start(transport="topic")
    publisher, inter_agent = await plain(peer)
    topic = await register(peer, "t")
    received = await peer.subscription(LocalGenericMessage, topic)
    out = await peer.publisher(LocalGenericMessage, "/gateway_out", matched=1)
    await peer.sees(topic, publishers=1, subscriptions=1)
    await until(lambda: gateway._types == {"t"})

    out.publish(outgoing("drone9", "t", b"out"))
    sent = await get(inter_agent)
    assert (sent.sender, sent.receiver, sent.type, bytes(sent.data)) == ("drone0", "drone9", "t", b"out")
    for message in (
        inter("drone9", "drone8", "t", b"for another"),
        inter("drone0", "", "t", b"own"),
        inter("drone9", "drone0", "unknown", b""),
        inter("drone9", "drone0", "unknown", b""),
        inter("drone9", "drone0", "t", b"for me"),
        inter("drone9", "", "t", b"for all"),
    ):
        publisher.publish(message)
    arrived = [await get(received) for _ in range(2)]
    assert [(m.agent, m.type, bytes(m.data)) for m in arrived] == [
        ("drone9", "t", b"for me"),
        ("drone9", "t", b"for all"),
    ]
    expected = {"own": 2, "for_others": 1, "unregistered": 2, "delivered_here": 2, "on_topic": 1}
    await until(lambda: {name: gateway.counters.get(name) for name in expected} == expected)
    assert sum("'unknown'" in record.getMessage() for record in caplog.records) == 1
    assert received.empty()


async def test_both_transports_deliver_once(start: StartGateway, peer: Peer, ground: Ground) -> None:
    """Two gateways with both transports in one domain: each message arrives once, also a repeated one; no loops.

    A plain node on the topic and an agent on the mesh alone are reached as well.
    """
    first = await start("drone0", transport="both")
    second = await start("drone1", transport="both", ros_args=("-r", "__ns:=/second"))
    answer = await call(peer, RegisterModule, "/second/register_module", RegisterModule.Request(type="t"))
    received = await peer.subscription(LocalGenericMessage, answer.topic)
    _, inter_agent = await plain(peer)
    ground.takes("t")
    out = await peer.publisher(LocalGenericMessage, "/gateway_out", matched=1)
    await peer.sees("/agent_to_agent", publishers=3, subscriptions=3)
    await until(lambda: first.node._inter_agent.get_subscription_count() == 3)
    await until(lambda: first._link.others().get("drone1", {}).get("takes") == ["t"])
    await until(lambda: first._link.others().get("ground", {}).get("takes") == ["t"])
    for data in (b"same", b"same", b"other"):
        out.publish(outgoing("", "t", data))
    out.publish(outgoing("drone1", "t", b"to one"))
    out.publish(outgoing("plain", "t", b"to the topic"))

    assert sorted([bytes((await get(received)).data) for _ in range(4)]) == [b"other", b"same", b"same", b"to one"]
    assert [(await get(ground.received)).data for _ in range(3)] == [b"same", b"same", b"other"]
    on_topic = [await get(inter_agent) for _ in range(4)]
    assert [bytes(m.data) for m in on_topic] == [b"same", b"same", b"other", b"to the topic"]
    await until(lambda: second.counters.get("second_copy") == 3)
    assert (received.empty(), ground.received.empty(), inter_agent.empty()) == (True, True, True)


# -- lifecycle -------------------------------------------------------------------------------------------------------


async def test_it_is_a_managed_node(start: StartGateway, peer: Peer, ground: Ground) -> None:
    """Tools drive it by ROS's lifecycle services; only an active gateway is on the mesh and passes messages.

    A transition that is not possible now is refused.
    """
    gateway = await start(auto=False)
    name = "/ca_gateway_node"

    async def change(transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool((await call(peer, ChangeState, f"{name}/change_state", request)).success)

    async def state() -> str:
        return str((await call(peer, GetState, f"{name}/get_state", GetState.Request())).current_state.label)

    assert await state() == "unconfigured"
    assert not await change(Transition.TRANSITION_ACTIVATE)
    assert await change(Transition.TRANSITION_CONFIGURE)
    topic = await register(peer, "t")
    received = await peer.subscription(LocalGenericMessage, topic)
    assert (await state(), "drone0" in ground.owner.names) == ("inactive", False)
    assert await change(Transition.TRANSITION_ACTIVATE)
    assert (await ground.owner.deliver("drone0", "t", b"1", deadline_s=PATIENCE_S)).value == "delivered"
    assert bytes((await get(received)).data) == b"1"
    assert await change(Transition.TRANSITION_DEACTIVATE)
    await until(lambda: "drone0" not in ground.owner.names)
    assert await change(Transition.TRANSITION_ACTIVATE)
    assert (await ground.owner.deliver("drone0", "t", b"2", deadline_s=PATIENCE_S)).value == "delivered"
    assert await change(Transition.TRANSITION_DEACTIVATE)
    assert await change(Transition.TRANSITION_CLEANUP)
    assert await state() == "unconfigured"
    await peer.sees(topic, publishers=0, subscriptions=1)
    assert await change(Transition.TRANSITION_CONFIGURE)
    assert await change(Transition.TRANSITION_INACTIVE_SHUTDOWN)
    assert (await state(), gateway.node.state) == ("finalized", "finalized")


async def test_parameters_are_as2_cas(start: StartGateway, peer: Peer) -> None:
    """The four parameters have as2_ca's names and defaults, readable by ROS tools, and rename what they name."""
    await start("drone0", transport="topic")
    names = ["agent_id", "inter_agent_topic", "out_messages_topic", "register_module_service_name"]
    answer = await call(peer, GetParameters, "/ca_gateway_node/get_parameters", GetParameters.Request(names=names))
    values = [value.string_value for value in answer.values]
    assert values == ["drone0", "/agent_to_agent", "gateway_out", "register_module"]
    renamed = ("agent_id:=d", "inter_agent_topic:=/i", "out_messages_topic:=o", "register_module_service_name:=r")
    await start(transport="topic", ros_args=("-r", "__ns:=/n", *(a for p in renamed for a in ("-p", p))))
    answer = await call(peer, RegisterModule, "/n/r", RegisterModule.Request(type="t"))
    assert answer.topic == "/n/t_in"
    await peer.sees("/i", publishers=1, subscriptions=1)
    await peer.sees("/n/o", subscriptions=1)


async def test_counters_are_where_ros_tools_look(start: StartGateway, peer: Peer, ground: Ground) -> None:
    """/diagnostics has the counters of the gateway, and gateway_agents who can be reached, for late listeners too."""
    await start()
    out = await peer.publisher(LocalGenericMessage, "/gateway_out", matched=1)
    diagnostics = await peer.subscription(DiagnosticArray, "/diagnostics")
    out.publish(outgoing("nobody", "t", b""))
    while True:
        (status,) = (await get(diagnostics)).status
        if {value.key: value.value for value in status.values}.get("no_such_agent") == "1":
            break
    assert (status.hardware_id, status.message) == ("drone0", "active, transport mesh")
    ground.takes("t")
    agents = await peer.subscription(String, "/gateway_agents", LATCHED)
    while '"ground": {"type": "unity"' not in (shown := (await get(agents)).data) or '"takes": ["t"]' not in shown:
        pass


async def test_a_message_of_a_type_with_a_deadline_waits(start: StartGateway, peer: Peer, ground: Ground) -> None:
    """A module's message waits for its receiver to register, and is given up, told and counted after its deadline."""
    gateway = await start(deadlines_s={"soon": 0.2, "later": 20.0})
    undelivered = await peer.subscription(LocalGenericMessage, "/gateway_undelivered")
    out = await peer.publisher(LocalGenericMessage, "/gateway_out", matched=1)
    await peer.sees("/gateway_undelivered", publishers=1, subscriptions=1)
    await until(lambda: gateway._link.knows("ground"))
    out.publish(outgoing("ground", "later", b"waited"))
    out.publish(outgoing("ground", "soon", b"gone"))
    told = await get(undelivered)
    assert (told.type, bytes(told.data)) == ("soon", b"not registered")
    ground.takes("later")
    assert (await get(ground.received)).data == b"waited"
    await until(lambda: gateway.counters.get("delivered") == 1)


async def test_last_values_reach_a_robot_that_joins(start: StartGateway, peer: Peer, ground: Ground) -> None:
    """With last_values, a module that registers learns what others last sent to all."""
    ground.owner.send("", "pose", serialize_message(String(data="old")))
    ground.owner.send("", "pose", serialize_message(String(data="last")))
    await start(last_values=["pose"])
    received = await peer.subscription(LocalGenericMessage, await register(peer, "pose"))
    message = await get(received)
    assert (message.agent, deserialize_message(bytes(message.data), String).data) == ("ground", "last")
    assert received.empty()


# -- the command -----------------------------------------------------------------------------------------------------


async def test_beside_a_robot_agent_it_is_the_same_robot(domain: int) -> None:
    """`macs agent --id 7` and `macs awareness --beside 7` are one agent with a name; by its name it is reached."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    env = {"ROS_DOMAIN_ID": str(domain)}
    async with (
        Program("router", "-l", endpoint),
        Program("agent", "--id", "7", "-e", endpoint, env=env),
        Program("awareness", "--name", "drone 7", "--beside", "7", "-e", endpoint, env=env) as program,
    ):
        assert program.ready == "awareness of drone 7 in /ca_gateway_node, active"
        listed = await macs("ls", "--json", "-e", endpoint)
        assert [(a["type"], a["id"], a["name"]) for a in listed] == [("ros", 7, "drone 7")]


@pytest.mark.parametrize("argument", ["--name=", "--id=0", "--transport=pigeon", "--beside=70000"])
async def test_a_wrong_option_is_wrong_usage(argument: str) -> None:
    """An empty name, an id out of range or an unknown transport end the command with exit code 2, no traceback."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "bridge", "awareness", argument), cwd=ROOT, stderr=asyncio.subprocess.PIPE
    )
    _, log = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert (process.returncode, "Traceback" in log.decode()) == (2, False)


async def test_it_starts_before_its_router(domain: int) -> None:
    """Modules register while no router is there yet; when it comes, the robot is on the mesh with their types."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = Settings(mesh=MeshSettings(connect=[endpoint]), awareness=AwarenessSettings(name="drone0"))
    peer = Peer(domain)
    async with open_gateway(settings, domain_id=domain) as gateway:
        starting = asyncio.create_task(gateway.autostart())
        topic = await register(peer, "t")
        received = await peer.subscription(LocalGenericMessage, topic)
        async with (
            Program("router", "-l", endpoint),
            macs_zenoh.join("unity", connect=[endpoint]) as agent,
            awareness.join(agent, "ground") as owner,
        ):
            await asyncio.wait_for(starting, PATIENCE_S)
            assert (await owner.deliver("drone0", "t", b"x", deadline_s=PATIENCE_S)).value == "delivered"
            assert (await get(received)).agent == "ground"
            await asyncio.to_thread(peer.session.close)
