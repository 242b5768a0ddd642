"""Rights are asked when they are used, and a topic's rules hold under whatever name it is reached."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

import macs_zenoh
from bridge.ros.agent import RobotAgent
from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.program import open_robot
from bridge.ros.requests import control
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.ros.topics import PublisherNode
from bridge.settings import RobotSettings, Settings, TopicRule
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import Refused
from macs_zenoh.mesh import Mesh, Sample, Token, Traffic
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.keyexpr import PRESENCE
from macs_zenoh.protocol.messages import ActionVerb, AddNode, CallFailure, Metadata, NodeType, encode_data
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import ControlRequest
from macs_zenoh.protocol.routing import call, inbox, keys_of
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message, parse_frame
from tests.support.ros_peer import Peer, adding, drive, removing
from tests.support.waiting import PATIENCE_S, get, until

ROBOT = 7
OPERATOR, STRANGER = 5, 6
TWIST = "geometry_msgs/Twist"
RULES = [
    TopicRule(match="/cmd_vel", exclusive=True, deadman_message={}),
    TopicRule(match="/locked", read_only=True),
]


class Sent:
    """What the robot sends to agents."""

    def __init__(self) -> None:
        self.messages: list[tuple[Registrant, Metadata, bytes]] = []

    def send(self, to: Registrant, metadata: Metadata, data: bytes) -> None:
        self.messages.append((to, metadata, data))


@asynccontextmanager
async def robot_nodes(session: RosSession, sent: Sent | None = None, **settings: Any) -> AsyncIterator[InterfaceNodes]:
    """Nodes of a robot with these settings."""
    rules = Rules(RobotSettings(rules=RULES, **settings))
    send = (sent or Sent()).send
    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, rules=rules, send=send))
    await nodes.open_stop("/emergency_stop")
    try:
        yield nodes
    finally:
        nodes.close()


@pytest.fixture
async def nodes(session: RosSession) -> AsyncIterator[InterfaceNodes]:
    async with robot_nodes(session) as nodes:
        yield nodes


def publishing(topic: str, registrant: int = OPERATOR, **options: Any) -> Any:
    return adding(topic, TWIST, node_type=NodeType.PUBLISHER, registrant=registrant, **options)


async def heard(nodes: InterfaceNodes, peer: Peer, topic: str) -> asyncio.Queue[Any]:
    """What ROS hears on a topic, from the first message on."""
    received = await peer.subscription(Twist, topic, 100)
    await until(lambda: nodes.robot.session.node.count_subscribers(topic) == 1)
    return received


# -- a node name and its topic belong together -----------------------------------------------------------------------


@pytest.mark.parametrize("node_type", list(NodeType))
async def test_a_node_name_of_another_topic_is_refused(nodes: InterfaceNodes, node_type: NodeType) -> None:
    """Nobody gets what others send to one topic by registering its node name for another one, of any node type."""
    with pytest.raises(Refused, match="'nd__cmd_vel' is not a valid node name for /evil_cmd, which is nd__evil_cmd"):
        await nodes.add(adding("/evil_cmd", TWIST, node_type=node_type, name="nd__cmd_vel"))
    assert len(nodes) == 0


async def test_commands_go_to_the_topic_that_their_sender_registered(nodes: InterfaceNodes, peer: Peer) -> None:
    """/cmd/vel and /cmd_vel have one node name: whoever registers the former first gets no command of who registered
    the latter, which is driven under its own rules."""
    good, evil = await heard(nodes, peer, "/cmd_vel"), await heard(nodes, peer, "/cmd/vel")
    await nodes.add(publishing("/cmd/vel", STRANGER, buffer_size=100))
    for number in range(20):  # the first of them before their registration
        if number == 3:
            await nodes.add(publishing("/cmd_vel", buffer_size=100))
        nodes.deliver(drive(number / 10))
        nodes.deliver(drive(9, STRANGER))
    assert [(await get(good)).linear.x for _ in range(20)] == [number / 10 for number in range(20)]
    assert [(await get(evil)).linear.x for _ in range(20)] == [9] * 20
    assert good.empty()
    assert evil.empty()
    assert nodes.drops == {}
    node = nodes.on_topic(NodeType.PUBLISHER, "/cmd_vel")
    assert node is not None
    assert node.status().control.holder == "unity/5"


async def test_a_name_that_may_mean_two_topics_is_for_those_who_registered(
    nodes: InterfaceNodes, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sender that never registered is heard while its node name means one topic, of those that the robot knows."""
    monkeypatch.setattr("bridge.ros.early.EarlyMessages.HOLD_S", 0.02)
    received = await heard(nodes, peer, "/cmd/vel")
    await nodes.add(publishing("/cmd/vel", STRANGER))  # a rule knows /cmd_vel
    nodes.deliver(drive(1))
    await until(lambda: nodes.drops["no_node"] == 1)
    nodes.deliver(drive(2, STRANGER))
    assert (await get(received)).linear.x == 2
    plain = await heard(nodes, peer, "/plain/name")
    await nodes.add(publishing("/plain/name", STRANGER))
    nodes.deliver(drive(3, topic="/plain/name"))
    assert (await get(plain)).linear.x == 3


async def test_one_sender_cannot_mean_two_topics_by_one_name(nodes: InterfaceNodes) -> None:
    """Its messages say no more than the node name."""
    await nodes.add(publishing("/cmd/vel"))
    with pytest.raises(Refused, match="/cmd_vel and /cmd/vel have the same node name nd__cmd_vel; use one of them"):
        await nodes.add(publishing("/cmd_vel"))


@pytest.mark.parametrize(
    ("node_type", "kind"),
    [
        (NodeType.PUBLISHER, "geometry_msgs/Twist"),
        (NodeType.CLIENT, "std_srvs/Trigger"),
        (NodeType.SERVICE, "std_srvs/Trigger"),
    ],
)
async def test_a_refused_registration_leaves_no_node(nodes: InterfaceNodes, node_type: int, kind: str) -> None:
    """What nobody has registered nobody would remove, and its name would be two topics' for ever."""
    await nodes.add(adding("/plain/name", kind, node_type=node_type))
    with pytest.raises(Refused, match="have the same node name"):
        await nodes.add(adding("/plain_name", kind, node_type=node_type))
    assert len(nodes) == 1
    assert nodes.on_topic(node_type, "/plain_name") is None


async def test_nobody_takes_the_name_of_the_emergency_stop(nodes: InterfaceNodes) -> None:
    """A stop is heard from anybody, so its node name has one meaning."""
    stop = await asyncio.gather(
        nodes.add(adding("/emergency/stop", "std_msgs/Bool", node_type=NodeType.PUBLISHER)), return_exceptions=True
    )
    assert "same node name nd__emergency_stop" in str(stop[0])
    await nodes.add(adding("emergency_stop", "std_msgs/Bool", node_type=NodeType.PUBLISHER))
    assert nodes.on_topic(NodeType.PUBLISHER, "/emergency_stop") is nodes.stop


@pytest.mark.parametrize("alias", ["cmd_vel", "/drive"])
async def test_rules_hold_under_every_name_of_a_topic(domain: int, peer: Peer, alias: str) -> None:
    """A relative or remapped name is the same node: exclusive control, dead-man and rules are one."""
    with RosSession("rosagent", domain_id=domain, ros_args=["--ros-args", "-r", "/drive:=/cmd_vel"]) as session:
        async with robot_nodes(session) as nodes:
            received = await heard(nodes, peer, "/cmd_vel")
            await nodes.add(publishing("/cmd_vel"))
            await nodes.add(publishing(alias, STRANGER))
            assert session.node.count_publishers("/cmd_vel") == 1
            nodes.deliver(drive(1))
            nodes.deliver(drive(2, STRANGER, topic=alias))
            assert nodes.drops == {"not_in_control": 1}
            nodes.remove(removing(alias, node_type=NodeType.PUBLISHER, registrant=STRANGER))
            nodes.deliver(drive(3))
            assert [(await get(received)).linear.x for _ in range(2)] == [1, 3]


async def test_names_cannot_get_around_a_rule(domain: int) -> None:
    """What a name resolves to is what rules and settings are asked about."""
    arguments = ["--ros-args", "-r", "/open:=/locked", "-r", "__ns:=/r7"]
    with RosSession("rosagent", domain_id=domain, ros_args=arguments) as session:
        async with robot_nodes(session, hide=["/r7/secret", "/r7/rosagent/**"]) as nodes:
            for topic, reason in (
                ("/open", "only read /locked"),
                ("secret", "/r7/secret is not open"),
                ("~/own", "/r7/rosagent/own is not open"),
                ("/r7//secret", "cannot be used"),
                ("/r7/secret/", "cannot be used"),
            ):
                with pytest.raises(Refused, match=reason):
                    await nodes.add(publishing(topic))
            assert len(nodes) == 0


async def test_control_is_asked_for_by_topic(nodes: InterfaceNodes) -> None:
    """A request for control means the topic that it names, whoever has a node of the same name."""
    await nodes.add(publishing("/cmd/vel", STRANGER))
    await nodes.add(publishing("/cmd_vel"))
    assert control(nodes, Registrant(2, OPERATOR), ControlRequest("take", "cmd_vel"), 0).done


# -- who may act -----------------------------------------------------------------------------------------------------


async def test_who_may_not_act_is_heard_nowhere(session: RosSession, peer: Peer) -> None:
    """Commands, calls, goals and requests for control of an agent that `register_allow` does not name do nothing, also
    where others registered the node, and the way through Zenoh's threads is no other. It may stop."""
    sent = Sent()
    async with robot_nodes(session, sent, register_allow=["unity/5"]) as nodes:
        received = await heard(nodes, peer, "/cmd_vel")
        called = asyncio.Queue[bool]()
        loop = asyncio.get_running_loop()

        def serve(request: Any, response: Any) -> Any:
            loop.call_soon_threadsafe(called.put_nowait, True)
            return response

        await peer.service(SetBool, "/lights", serve, session)
        await nodes.add(publishing("/cmd_vel"))
        await nodes.add(adding("/lights", "std_srvs/SetBool", node_type=NodeType.CLIENT))

        request = bytes(serialize_message(SetBool.Request(data=True)))
        call = Metadata(2, STRANGER, 3, CallFailure.manager, NodeType.CLIENT, "nd__lights", "std_srvs/SetBool")
        goal = Metadata(2, STRANGER, 4, ActionVerb.GOAL.value, NodeType.ACTION, "nd__count", "a/Count")
        for _ in range(3):
            nodes.deliver(drive(1, STRANGER))
            nodes.deliver(Message("unity", STRANGER, call, request))
            nodes.deliver(Message("unity", STRANGER, goal, bytes(20)))
        for action in ("take", "give"):
            with pytest.raises(Refused, match="unity/6"):
                control(nodes, Registrant(2, STRANGER), ControlRequest(action, "/cmd_vel", to=STRANGER), 0)  # type: ignore[arg-type]
        for to_type, named in ((2, "unity/6"), (0, "0/6"), (99, "99/6")):  # nor be given it
            with pytest.raises(Refused, match=named):
                control(nodes, Registrant(2, OPERATOR), ControlRequest("give", "/cmd_vel", STRANGER, to_type), 0)

        assert nodes.drops == {"not_allowed": 9, "call_refused": 3}
        told = [
            (to, metadata.request_id, data)
            for to, metadata, data in sent.messages
            if metadata.message_manager == CallFailure.manager
        ]
        assert [(to, number) for to, number, _ in told] == [(Registrant(2, STRANGER), 3)] * 3
        assert all(b'"refused"' in data for _, _, data in told)
        nodes.deliver(drive(2))
        assert (await get(received)).linear.x == 2
        assert received.empty()
        assert called.empty()
        stop = Metadata(2, STRANGER, 0, "", NodeType.PUBLISHER, "nd__emergency_stop", "std_msgs/Bool")
        nodes.deliver(Message("unity", STRANGER, stop, bytes(serialize_message(Bool(data=True)))))
        assert nodes.robot.stop.stopped


async def test_a_right_ends_when_it_is_taken_away(session: RosSession) -> None:
    """What was found out about an agent is asked again when somebody came, left or changed its group."""
    groups = {Registrant(2, OPERATOR): 9}
    rules = Rules(RobotSettings(register_allow=["group/9"], groups={"9": ["unity"]}))
    robot = Robot(session, 7, lambda node, frame: None, rules=rules, group_of=lambda agent: groups.get(agent, 0))
    nodes = InterfaceNodes(robot)
    try:
        await nodes.add(publishing("/cmd_vel"))
        nodes.deliver(drive(1))
        assert nodes.drops == {}
        groups.clear()
        nodes.rights.changed()
        nodes.deliver(drive(1))
        assert nodes.drops == {"not_allowed": 1}
    finally:
        nodes.close()


@asynccontextmanager
async def not_seen_yet(session: RosSession, peer: Peer) -> AsyncIterator[tuple[InterfaceNodes, set[Registrant], Any]]:
    """Nodes of a robot on which rights depend on a presence that has not come; who is seen; and what ROS hears."""
    seen: set[Registrant] = set()
    rules = Rules(RobotSettings(register_allow=["group/9", "unity/1"], groups={"9": ["unity"]}))
    robot = Robot(session, 7, lambda node, frame: None, rules=rules, group_of=lambda agent: 9 * (agent in seen))
    robot.is_online = seen.__contains__
    nodes = InterfaceNodes(robot)
    received = await heard(nodes, peer, "/cmd_vel")
    await nodes.add(publishing("/cmd_vel", 1))
    try:
        yield nodes, seen, received
    finally:
        nodes.close()


async def test_what_comes_before_the_presence_of_its_sender_waits(session: RosSession, peer: Peer) -> None:
    """A command can overtake the news that its sender is in a group; it is judged when that has come, or given up."""
    async with not_seen_yet(session, peer) as (nodes, seen, received):
        for sender in (OPERATOR, STRANGER):
            nodes.deliver(drive(sender, sender))
        assert nodes.drops == {}
        seen.add(Registrant(2, OPERATOR))
        nodes.arrived(Registrant(2, OPERATOR))
        assert (await get(received)).linear.x == OPERATOR
        await until(lambda: nodes.drops == {"not_allowed": 1})
        assert received.empty()


def overtaking(nodes: InterfaceNodes, monkeypatch: pytest.MonkeyPatch) -> threading.Thread:
    """A thread as Zenoh's that brings a newer command while the older one is being delivered."""
    newer = threading.Thread(target=nodes.deliver, args=[drive(2.0, OPERATOR)])
    receive = PublisherNode.receive

    def slow(node: PublisherNode, message: Message) -> None:
        if threading.current_thread() is not newer:
            newer.start()
            newer.join(0.3)  # as long as it could take to overtake
        receive(node, message)

    monkeypatch.setattr(PublisherNode, "receive", slow)
    return newer


async def test_what_waited_comes_before_what_comes_while_it_is_delivered(
    session: RosSession, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A newer command comes in Zenoh's thread while the loop delivers the one that waited: it does not overtake."""
    async with not_seen_yet(session, peer) as (nodes, seen, received):
        nodes.deliver(drive(1.0, OPERATOR))
        newer = overtaking(nodes, monkeypatch)
        seen.add(Registrant(2, OPERATOR))
        nodes.arrived(Registrant(2, OPERATOR))
        await asyncio.to_thread(newer.join)
        assert [(await get(received)).linear.x for _ in range(2)] == [1.0, 2.0]


async def test_what_waited_comes_before_what_is_judged_first(session: RosSession, peer: Peer) -> None:
    """A newer command comes when its sender has been seen, and before the loop has heard of that."""
    async with not_seen_yet(session, peer) as (nodes, seen, received):
        for x in (1.0, 2.0):
            nodes.deliver(drive(x, OPERATOR))
        seen.add(Registrant(2, OPERATOR))
        nodes.rights.changed()
        await asyncio.to_thread(nodes.deliver, drive(3.0, OPERATOR))
        nodes.arrived(Registrant(2, OPERATOR))
        assert [(await get(received)).linear.x for _ in range(3)] == [1.0, 2.0, 3.0]


async def test_what_waited_for_its_registration_comes_first(
    session: RosSession, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same where the node was there for others, under a name that can mean two topics, and is registered now."""
    async with robot_nodes(session) as nodes:
        received = await heard(nodes, peer, "/cmd_vel")
        await nodes.add(publishing("/cmd_vel", 1))
        monkeypatch.setattr(nodes._places, "sole", lambda key: None)
        nodes.deliver(drive(1.0, OPERATOR))
        newer = overtaking(nodes, monkeypatch)
        await nodes.add(publishing("/cmd_vel"))
        await asyncio.to_thread(newer.join)
        assert [(await get(received)).linear.x for _ in range(2)] == [1.0, 2.0]


async def test_what_waits_of_a_stranger_does_not_pass_with_anothers_registration(
    session: RosSession, peer: Peer
) -> None:
    """A command of somebody who was not seen waits for a node; when one who may opens it, the stranger's stays."""
    async with not_seen_yet(session, peer) as (nodes, _seen, _received):
        other = await heard(nodes, peer, "/other")
        nodes.deliver(drive(6.0, STRANGER, topic="/other"))
        nodes.deliver(drive(1.0, 1, topic="/other"))
        await nodes.add(publishing("/other", 1))
        assert (await get(other)).linear.x == 1.0
        await until(lambda: nodes.drops["not_allowed"] == 1)
        assert other.empty()


async def test_a_group_that_one_only_says_gives_no_right(router: str, domain: int) -> None:
    """A right of a group is for those of whom the settings believe it; others are refused, and heard nowhere."""
    allow = RobotSettings(id=ROBOT, rules=RULES, register_allow=["group/9"], groups={"9": ["unity/5"]})
    async with (
        open_robot(Settings(mesh=MeshSettings(connect=[router]), robot=allow), domain_id=domain) as robot,
        macs_zenoh.join("unity", id=OPERATOR, group=9, connect=[router]) as operator,
        macs_zenoh.join("unity", id=STRANGER, group=9, connect=[router]) as stranger,
    ):
        await until(lambda: all((1, ROBOT) in agent.directory for agent in (operator, stranger)))
        await until(lambda: all((2, number) in robot.agent.directory for number in (OPERATOR, STRANGER)))
        await operator.call("ros", ROBOT, "add_node", encode_data(publishing("/cmd_vel")))
        with pytest.raises(Refused, match="unity/6 may only register for topics"):
            await stranger.call("ros", ROBOT, "add_node", encode_data(publishing("/cmd_vel", STRANGER)))
        take = encode_data(ControlRequest("take", "/cmd_vel"))
        assert b"unity/6 may" in await stranger.call("ros", ROBOT, "control", take)
        metadata = Metadata(node_type=NodeType.PUBLISHER, node_name="nd__cmd_vel")
        stranger.send(drive(1).data, to="ros", ids=[ROBOT], metadata=metadata)
        await until(lambda: robot.nodes.drops["not_allowed"] == 1)
        operator.send(drive(1).data, to="ros", ids=[ROBOT], metadata=metadata)
        node = robot.nodes.on_topic(NodeType.PUBLISHER, "/cmd_vel")
        assert node is not None
        await until(lambda: node.status().control.holder == "unity/5")


# -- who serves ------------------------------------------------------------------------------------------------------


async def test_what_a_node_of_the_robot_serves_no_headset_serves(session: RosSession, peer: Peer) -> None:
    """A service that a ROS node has is refused to headsets, so that no answer of theirs can be the first."""
    sent = Sent()
    async with robot_nodes(session, sent) as nodes:
        service = await peer.session.run(lambda: peer.session.node.create_service(SetBool, "/lights", _serve))
        await until(lambda: "/peer" in session.servers_elsewhere("/lights"))
        asked = adding("/lights", "std_srvs/SetBool", node_type=NodeType.SERVICE)
        with pytest.raises(Refused, match="/lights is served by /peer on this robot"):
            await nodes.add(asked)
        await peer.session.run(lambda: peer.session.node.destroy_service(service))
        await until(lambda: not session.servers_elsewhere("/lights"))
        await nodes.add(asked)
        assert len(nodes) == 1


async def test_a_headset_serves_until_a_node_of_the_robot_does(
    session: RosSession, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When a ROS node begins to serve what a headset serves, the headset's service is withdrawn, and counted."""
    monkeypatch.setattr("bridge.ros.served.ServiceNode.WATCH_S", 0.05)
    async with robot_nodes(session) as nodes:
        await nodes.add(adding("/lights", "std_srvs/SetBool", node_type=NodeType.SERVICE))
        await asyncio.sleep(0.3)
        assert len(nodes) == 1
        await peer.session.run(lambda: peer.session.node.create_service(SetBool, "/lights", _serve))
        await until(lambda: len(nodes) == 0)
        assert nodes.drops == {"withdrawn": 1}
        await until(lambda: session.node.count_services("/lights") == 1)


def _serve(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    response.success = True
    return response


# -- an id is who has it now -----------------------------------------------------------------------------------------


class Lodging:
    """Agents that a session takes in one after the other under one id, as a gateway does."""

    ID = 300

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.inbox: asyncio.Queue[bytes] = asyncio.Queue()
        self._reading = mesh.subscribe(inbox(2, self.ID), self._take)
        self._token: Token | None = None

    def _take(self, batch: Iterator[Sample]) -> None:
        for _, payload in batch:
            self.inbox.put_nowait(bytes(payload))

    def next(self, epoch: int) -> None:
        """The one before leaves, and at once another one comes."""
        if self._token is not None:
            self._token.close()
        self._token = self.mesh.declare_token(AgentInfo(2, self.ID, 0, self.mesh.zid, epoch).presence)

    def send(self, metadata: Metadata, data: bytes) -> None:
        frame = encode_frame(1, [ROBOT], message=encode_message(metadata.sent_by(2, self.ID).encode(), data))
        for key in keys_of(parse_frame(frame).header, 2, self.ID):
            self.mesh.put(key, frame, Traffic.CALL)

    async def register(self, request: AddNode) -> None:
        key, frame = call((1, ROBOT), "add_node", (2, self.ID), encode_data(request), Metadata(2, self.ID), MACS)
        await self.mesh.query(key, frame, timeout_s=PATIENCE_S)


async def test_nothing_of_an_agent_is_its_successors(router: str, domain: int, peer: Peer) -> None:
    """When an agent leaves and another one gets its id at once, its registrations, its control, its calls and
    their answers have ended, and the other begins with nothing."""
    answer = threading.Event()
    asked = asyncio.Queue[bool]()
    loop = asyncio.get_running_loop()

    def serve(request: Any, response: Any) -> Any:
        loop.call_soon_threadsafe(asked.put_nowait, request.data)
        answer.wait(10)
        response.success = True
        return response

    await peer.session.run(lambda: peer.session.node.create_service(SetBool, "/slow", serve))
    settings = Settings(
        mesh=MeshSettings(connect=[router]),
        robot=RobotSettings(id=ROBOT, rules=[TopicRule(match="/cmd_vel", exclusive=True, hold_s=60)]),
    )
    async with (
        open_robot(settings, domain_id=domain) as robot,
        await Mesh.open(MeshSettings(connect=[router])) as mesh,
    ):
        await until(lambda: robot.session.node.count_services("/slow") == 1)
        lodging = Lodging(mesh)
        lodging.next(1)
        await until(lambda: (2, Lodging.ID) in robot.agent.directory)
        await lodging.register(publishing("/cmd_vel", Lodging.ID))
        await lodging.register(adding("/slow", "std_srvs/SetBool", node_type=NodeType.CLIENT, registrant=Lodging.ID))
        lodging.send(Metadata(node_type=NodeType.PUBLISHER, node_name="nd__cmd_vel"), drive(1).data)
        question = Metadata(request_id=41, node_type=NodeType.CLIENT, node_name="nd__slow")
        lodging.send(question, bytes(serialize_message(SetBool.Request(data=True))))
        await get(asked)
        drive_node = robot.nodes.on_topic(NodeType.PUBLISHER, "/cmd_vel")
        assert drive_node is not None
        assert drive_node.status().control.holder == f"unity/{Lodging.ID}"

        lodging.next(2)
        await until(lambda: len(robot.nodes) == 0)
        found = await until(lambda: robot.agent.directory.get(2, Lodging.ID))
        assert found.epoch == 2
        answer.set()
        await asyncio.sleep(0.3)
        await lodging.register(adding("/slow", "std_srvs/SetBool", node_type=NodeType.CLIENT, registrant=Lodging.ID))
        lodging.send(question, bytes(serialize_message(SetBool.Request(data=False))))
        assert await get(asked) is False
        assert parse_frame(await get(lodging.inbox)).body
        assert lodging.inbox.empty(), "its predecessor's answer came as well"


async def test_a_session_that_only_lost_its_way_keeps_what_it_had(router: str, domain: int) -> None:
    """The same agent is no other one for having been away: what lingers for it stays."""
    rule = TopicRule(match="/log", cache=10)
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=ROBOT, rules=[rule]))
    async with (
        open_robot(settings, domain_id=domain) as robot,
        await Mesh.open(MeshSettings(connect=[router])) as mesh,
    ):
        lodging = Lodging(mesh)
        lodging.next(1)
        await until(lambda: _epoch(robot) == 1)
        await lodging.register(adding("/log", registrant=Lodging.ID))
        lodging.next(1)
        await mesh.tokens(PRESENCE.every())
        await asyncio.sleep(0.2)
        assert len(robot.nodes) == 1
        lodging.next(2)
        await until(lambda: len(robot.nodes) == 0)


def _epoch(robot: RobotAgent) -> int:
    found = robot.agent.directory.get(2, Lodging.ID)
    return found.epoch if found is not None else 0
