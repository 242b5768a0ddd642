"""What the gateway keeps from the existing programs because it would harm them."""

from __future__ import annotations

import asyncio
import json

import pytest

import macs_zenoh
from macs_zenoh.errors import Refused
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.existing import CDR
from macs_zenoh.protocol.keyexpr import BROADCAST, GROUP, PING
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AddNode,
    Metadata,
    NodeRefused,
    NodeType,
    Registration,
    RemoveNode,
    StreamData,
    decode_data,
    encode_data,
    encode_management,
)
from macs_zenoh.protocol.routing import call, unicast_key
from macs_zenoh.protocol.wire import PROBE, encode_frame, encode_message
from macs_zenoh.streams import Streams
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.matching import answer_of, matched
from tests.support.sockets import Socket, socket
from tests.support.waiting import PATIENCE_S, until

TEXT = CDR + b"\x05\x00\x00\x00text\x00"


def topic_data(robot: Socket, receivers: list[int], text: bytes) -> bytes:
    """A frame of an existing robot's topic /chatter."""
    metadata = Metadata(1, robot.id, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__chatter", "std_msgs/String")
    management = encode_management(StreamData({"2": receivers}))
    return encode_frame(1, management=management, message=encode_message(metadata.encode(), text))


async def test_topic_data_for_a_node_of_another_type(start_gateway: StartGateway, connect: Connect) -> None:
    """A headset that publishes to a topic gets no topic data under that node's name: it would go deaf for good."""
    gateway = await start_gateway()
    subscriber, publisher = await connect(gateway), await connect(gateway)
    async with socket(gateway) as robot:
        robot.configure(agent_type=1)
        await until(lambda: (1, robot.id) in gateway.directory)
        subscription = await subscriber.subscribe("/chatter", "std_msgs/String", agents=[robot.id])
        await robot.message()
        await publisher.advertise("/chatter", "std_msgs/String", agents=[robot.id])
        await robot.message()
        robot.writer.write(topic_data(robot, [publisher.id, subscriber.id], b"text"))
        assert bytes((await asyncio.wait_for(subscription.__anext__(), PATIENCE_S)).data) == b"text"
        connection = gateway.agents.find(2, publisher.id)
        assert connection.all_drops()["wrong_node_type"] == 1


def registration(headset: Socket, robots: list[int], node: AddNode | RemoveNode) -> bytes:
    """A headset's registration on robots, or the end of it."""
    registration = Registration(headset.id, node.node_type, node.node_name, robots)
    metadata = Metadata(2, headset.id, message_manager=node.manager).encode()
    message = encode_message(metadata, encode_data(node))
    return encode_frame(management=encode_management(registration), message=message)


async def test_a_robot_program_is_told_once(start_gateway: StartGateway) -> None:
    """An existing robot hears of a registration once, however often it is repeated, and again after it was undone."""
    gateway = await start_gateway()
    async with socket(gateway) as robot, socket(gateway) as headset:
        robot.configure(agent_type=1)
        headset.configure()
        await until(lambda: (1, robot.id) in gateway.directory)
        adding = AddNode(2, headset.id, 1, "nd__chatter", "/chatter", "std_msgs/String")
        removing = RemoveNode(2, headset.id, 1, "nd__chatter")
        for _ in range(2):
            for robots in ([robot.id], [77], [robot.id, 77], []):
                headset.writer.write(registration(headset, robots, adding))
                await headset.online()
            headset.writer.write(registration(headset, [robot.id, 77], removing))
            assert (await robot.message())[0].message_manager == AddNode.manager
            assert (await robot.message())[0].message_manager == RemoveNode.manager


async def test_a_short_silence_is_noticed(start_gateway: StartGateway) -> None:
    """An agent that is silent from its configuration on is gone after the time for silence, not for the handshake."""
    gateway = await start_gateway(idle_timeout_s=0.3, handshake_timeout_s=60.0)
    async with socket(gateway) as agent:
        agent.configure()
        with pytest.raises(ConnectionError):
            await agent.message()


async def test_messages_of_an_unknown_node_go_through(start_gateway: StartGateway, connect: Connect) -> None:
    """A message under the name of a node that the headset has not registered is delivered, as it always was."""
    gateway = await start_gateway()
    listener, talker = await connect(gateway), await connect(gateway)
    async with socket(gateway) as robot:
        robot.configure(agent_type=1)
        metadata = Metadata(1, robot.id, 0, "", NodeType.CLIENT, "nd__set", "std_srvs/SetBool").encode()
        robot.writer.write(encode_frame(2, (listener.id,), message=encode_message(metadata, b"answer")))
        await talker.send(json.dumps({"after": True}).encode(), ids=[listener.id], manager="Greeting")
        heard = [await listener.receive(PATIENCE_S), await listener.receive(PATIENCE_S)]
        assert sorted(bytes(message.data) for message in heard) == [b"answer", b'{"after": true}']


# -- what a program on the mesh could pretend ------------------------------------------------------------------------


FORGED = {
    "another id": Metadata(ROS, 8, 5, "Greeting").encode(),
    "another type": Metadata(UNITY, 7, 5, "Greeting").encode(),
    "nobody": Metadata(request_id=5, message_manager="Greeting").encode(),
    "in capitals": Metadata(ROS, 7, 5, "Greeting").encode()[:-1] + b',"SENDERAGENTID":8}',
    "in two ways": b'{"sender_agent_id":8,"SenderAgentId":8,"requestId":5,"messageManager":"Greeting"}',
}


@pytest.mark.parametrize("forged", FORGED.values(), ids=FORGED.keys())
async def test_the_sender_is_who_the_key_says(
    forged: bytes, router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """Whatever metadata says, a headset is told the sender of the key, for each frame of a run, by every key."""
    gateway = await start_gateway()
    true = Metadata(ROS, 7, 5, "Greeting").encode()
    async with socket(gateway) as headset, await Mesh.open(patient(router)) as robot:
        headset.configure(group=3)
        await headset.online()
        for key in (
            unicast_key(UNITY, headset.id, ROS, 7),
            GROUP.of(group=3, type=UNITY, from_type=ROS, from_id=7),
            BROADCAST.of(from_type=ROS, from_id=7),
        ):
            await matched(robot, key)  # the group's is subscribed to once the headset is in it
            said = [true, forged, forged, forged, true]
            frames = [encode_frame(UNITY, message=encode_message(raw, b"%d" % n)) for n, raw in enumerate(said)]
            robot.put(key, b"".join(frames))
            for number in range(len(said)):
                raw, body = await headset.raw_message()
                assert body == b"%d" % number
                fields = json.loads(raw)
                sender = {name: value for name, value in fields.items() if "sender" in name.lower()}
                assert sender == {"senderAgentType": ROS, "senderAgentId": 7}
                assert (fields["requestId"], fields["messageManager"]) == (5, "Greeting")
        lied = forged != FORGED["in capitals"]  # there the key that we read is true, and the other one is taken out
        assert gateway.drops == ({"wrong_sender": 9} if lied else {})


async def test_topic_data_only_for_whom_registered_it(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """Robot 7 reaches no headset that registered the topic on robot 8 only, whom it lists and whatever it says; and
    nobody takes its data for robot 8's."""
    gateway = await start_gateway()
    of_seven, of_eight = await connect(gateway), await connect(gateway)

    def data(robot: int, node: str, text: bytes) -> bytes:
        metadata = Metadata(ROS, robot, 0, StreamData.manager, NodeType.SUBSCRIBER, node, "std_msgs/String")
        management = encode_management(StreamData({"2": [of_eight.id, of_seven.id, of_eight.id, of_seven.id]}))
        return encode_frame(ROS, management=management, message=encode_message(metadata.encode(), text))

    async with (
        macs_zenoh.join("ros", id=7, settings=patient(router)) as seven,
        macs_zenoh.join("ros", id=8, settings=patient(router)) as eight,
    ):
        asked = [_accepting(robot) for robot in (seven, eight)]
        chatter = await of_seven.subscribe("/chatter", "std_msgs/String", agents=[7])
        other = await of_eight.subscribe("/other", "std_msgs/String", agents=[7])
        true = await of_eight.subscribe("/chatter", "std_msgs/String", agents=[8])
        await until(lambda: [len(calls) for calls in asked] == [2, 1])  # the gateway has subscribed before it calls
        Streams(seven).publish("nd__chatter", data(8, "nd__chatter", b"forged"))
        Streams(seven).publish("nd__other", data(7, "nd__chatter", b"under another node's key"))
        Streams(seven).publish("nd__other", data(7, "nd__other", b"seven's"))
        heard = await asyncio.wait_for(other.__anext__(), PATIENCE_S)
        assert bytes(heard.data) == b"seven's"
        Streams(eight).publish("nd__chatter", data(8, "nd__chatter", b"eight's"))
        heard = await asyncio.wait_for(true.__anext__(), PATIENCE_S)
        assert (bytes(heard.data), heard.metadata.sender_agent_id) == (b"eight's", 8)
        heard = await asyncio.wait_for(chatter.__anext__(), PATIENCE_S)
        assert (bytes(heard.data), heard.metadata.sender_agent_id) == (b"forged", 7)
        # of_eight on 7's /chatter; both under the other node's key; of_seven on 7's /other and on 8's /chatter
        assert gateway.drops == {"wrong_sender": 1, "not_registered": 5}


async def test_topic_data_stops_when_the_registration_does(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """A headset that has taken its registration back gets no more of the topic, though the robot still lists it."""
    gateway = await start_gateway()
    async with (
        socket(gateway) as left,
        socket(gateway) as stays,
        macs_zenoh.join("ros", id=7, settings=patient(router)) as robot,
    ):
        asked = _accepting(robot)
        for headset in (left, stays):
            headset.configure()
            adding = AddNode(UNITY, headset.id, 1, "nd__chatter", "/chatter", "std_msgs/String")
            headset.writer.write(registration(headset, [7], adding))
        await until(lambda: len(asked) == 2)  # the gateway has subscribed before it calls
        left.writer.write(registration(left, [7], RemoveNode(UNITY, left.id, 1, "nd__chatter")))
        await left.online()
        metadata = Metadata(ROS, 7, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__chatter", "std_msgs/String")
        management = encode_management(StreamData({"2": [left.id, stays.id]}))
        message = encode_message(metadata.encode(), TEXT)
        Streams(robot).publish("nd__chatter", encode_frame(ROS, management=management, message=message))
        assert (await stays.message())[1] == TEXT
        robot.broadcast(b"next")
        assert (await left.message())[1] == b"next"
        assert gateway.drops == {"not_registered": 1}


async def test_what_comes_with_the_configuration_is_by_who_the_agent_becomes(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """A robot gets another id when it says that it is one. What it sent in the same moment, before it or after, bears
    that id, reaches existing programs so, and what it registered ends with it."""
    gateway = await start_gateway(robots=[9])
    callers: list[tuple[int, int]] = []

    async def add(call: macs_zenoh.Call) -> bytes:
        node = decode_data(AddNode, call.data)
        callers.append((call.sender_id, node.registrant_agent_id))
        return b""

    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as other, socket(gateway) as headset:
        other.serve("add_node", add)
        headset.configure()
        await until(lambda: (ROS, 7) in gateway.directory and (UNITY, headset.id) in gateway.directory)
        async with socket(gateway) as robot:
            about = Metadata(ROS, robot.id, message_manager="Greeting")
            greeting = encode_frame(UNITY, (headset.id,), message=encode_message(about.encode(), b"{}"))
            robot.writer.write(greeting)
            robot.configure(agent_type=ROS)
            node = AddNode(ROS, robot.id, 1, "nd__chatter", "/chatter", "std_msgs/String")
            robot.writer.write(registration(robot, [7], node) + greeting)
            said = [(await headset.message())[0] for _ in range(2)]
            assert [(about.message_manager, about.sender_agent_id) for about in said] == [("Greeting", 9)] * 2
            await until(lambda: callers)
            assert robot.id != 9
            assert set(callers) == {(9, 9)}
            assert len(gateway._registry.robots._registrations) == 1
        await until(lambda: not len(gateway._registry.robots._registrations))


def _accepting(robot: macs_zenoh.Agent) -> list[macs_zenoh.Call]:
    """Let everybody register on a robot; the calls with which they do."""
    calls: list[macs_zenoh.Call] = []

    async def add(call: macs_zenoh.Call) -> bytes:
        calls.append(call)
        return b""

    robot.serve("add_node", add)
    return calls


async def test_a_registration_for_somebody_else_is_refused(router: str, start_gateway: StartGateway) -> None:
    """Nobody registers another agent on an existing robot program, nor takes its registration back."""
    gateway = await start_gateway()
    async with socket(gateway) as robot, await Mesh.open(patient(router)) as mesh:
        robot.configure(agent_type=ROS)
        await robot.online()

        async def ask(verb: str, node: AddNode | RemoveNode, caller: int) -> None:
            metadata = Metadata(UNITY, caller, message_manager=node.manager)
            key, frame = call((ROS, robot.id), verb, (UNITY, caller), encode_data(node), metadata)
            await answer_of(mesh, key, frame)  # it is online a moment before it serves

        adding = AddNode(UNITY, 600, 1, "nd__chatter", "/chatter", "std_msgs/String")
        removing = RemoveNode(UNITY, 600, 1, "nd__chatter")
        await ask("add_node", adding, 600)
        for verb, node in (("add_node", adding), ("remove_node", removing)):
            with pytest.raises(Refused, match="unity/601 cannot register or remove nodes for unity/600"):
                await ask(verb, node, 601)
        await ask("remove_node", removing, 600)
        for manager in (AddNode.manager, RemoveNode.manager):
            metadata, _ = await robot.message()
            assert (metadata.message_manager, metadata.sender_agent_id) == (manager, 600)


async def test_a_probe_is_no_loss(router: str, start_gateway: StartGateway, connect: Connect) -> None:
    """What `macs doctor` and `macs security check` send to see whether it arrives reaches no headset, and is counted
    nowhere."""
    gateway = await start_gateway()
    headset = await connect(gateway)
    async with await Mesh.open(patient(router)) as mesh:
        last = gateway.blocks[0] * 256 + 255
        to_it, to_all = unicast_key(UNITY, headset.id, UNITY, last), BROADCAST.of(from_type=UNITY, from_id=last)
        for key in (to_it, to_all):
            await matched(mesh, key)
        for key in (unicast_key(UNITY, last, UNITY, last), to_it, to_all):
            mesh.put(key, PROBE)
        message = encode_message(Metadata(message_manager="Greeting").encode(), b"next")
        mesh.put(to_it, encode_frame(UNITY, message=message))
        assert bytes((await headset.receive(PATIENCE_S)).data) == b"next"
        assert gateway.drops == {"wrong_sender": 1}  # the greeting named nobody


async def test_an_agent_is_told_the_true_sender(router: str) -> None:
    """A Python agent that looks into the metadata of a message or a call finds the sender of the key there."""
    asked: list[Metadata] = []

    async def look(asking: macs_zenoh.Call) -> bytes:
        asked.append(asking.metadata)
        return b""

    async with (
        macs_zenoh.join("ros", id=9, settings=patient(router)) as agent,
        await Mesh.open(patient(router)) as robot,
    ):
        agent.serve("look", look)
        forged = Metadata(ROS, 8, 5, "Greeting")
        key = unicast_key(ROS, 9, ROS, 7)
        await matched(robot, key)
        robot.put(key, encode_frame(ROS, (9,), message=encode_message(forged.encode(), b"text")))
        message = await asyncio.wait_for(agent.receive(), PATIENCE_S)
        await answer_of(robot, *call((ROS, 9), "look", (ROS, 7), b"", forged))
        assert message.metadata == asked[0] == Metadata(ROS, 7, 5, "Greeting")


async def test_a_silent_agent_is_away_and_stays(
    router: str, start_gateway: StartGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An agent that nothing is heard of stays connected for a minute, and its gateway says that it is away."""
    monkeypatch.setattr("bridge.gateway.connection.AWAY_S", 0.3)
    gateway = await start_gateway()
    assert gateway.settings.idle_timeout_s == 60
    lively = await connect(gateway, heartbeat_s=0.05)
    async with socket(gateway) as taken_off, await Mesh.open(patient(router)) as mesh:
        taken_off.configure()
        away = [(UNITY, taken_off.id)]

        async def told() -> list[tuple[int, int]]:
            return ping.decode(await mesh.query(PING.of(zid=gateway.mesh.zid), b"", timeout_s=PATIENCE_S))[0].away

        async def is_told() -> bool:
            return await told() == away

        await until(lambda: gateway.agents.find(UNITY, taken_off.id))
        await until(is_told, every_s=0.05)  # a gateway answers a hundred pings a second
        assert lively.connected
        await taken_off.online()
        assert await told() == []


async def test_a_registration_in_two_frames_is_refused(start_gateway: StartGateway) -> None:
    """A client that sends management data and message as frames of their own is told that they are one."""
    gateway = await start_gateway()
    async with socket(gateway) as robot, socket(gateway) as headset:
        robot.configure(agent_type=ROS)
        headset.configure()
        await until(lambda: (ROS, robot.id) in gateway.directory)
        node = AddNode(UNITY, headset.id, 1, "nd__chatter", "/chatter", "std_msgs/String")
        management = encode_management(Registration(headset.id, 1, "nd__chatter", [robot.id], [], "/chatter"))
        message = encode_message(Metadata(message_manager=node.manager).encode(), encode_data(node))
        headset.writer.write(encode_frame(management=management) + encode_frame(ROS, (robot.id,), message=message))
        metadata, body = await headset.message()
        assert metadata.message_manager == NodeRefused.manager
        refused = decode_data(NodeRefused, body)
        assert refused.tos_name == "/chatter"
        assert "one frame, not two" in refused.reason
        headset.writer.write(registration(headset, [robot.id], node))
        assert (await robot.message())[0].message_manager == AddNode.manager


async def test_robots_come_over_tcp_only_under_ids_set_aside(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """By default no TCP agent becomes a robot, so none takes the id of one that is away; where ids are set aside,
    robots get those and headsets others."""
    closed, opened = await start_gateway(robots=[]), await start_gateway(robots=[1, 9])
    async with socket(closed) as thief:
        thief.configure(agent_type=ROS)
        thief.writer.write(
            encode_frame(0, message=encode_message(Metadata(message_manager="Greeting").encode(), b"x"))
        )
        with pytest.raises(ConnectionError):
            await thief.message()
        assert closed.drops["robot_not_allowed"] == 1
    async with (
        macs_zenoh.join("ros", id=1, settings=patient(router)),
        socket(opened) as first,
        socket(opened) as second,
    ):
        await until(lambda: (ROS, 1) in opened.directory)
        first.configure(agent_type=ROS)
        await until(lambda: opened.agents.find(ROS, 9))
        headset = await connect(opened)
        await headset.send(b"x", to=ROS, ids=[9], manager="Greeting")
        node = await headset.advertise("/talk", "std_msgs/String", agents=[9])
        assert (await first.message())[0].message_manager == AddNode.manager
        await node.publish(TEXT)
        assert (await first.message())[1] == TEXT
        second.configure(agent_type=ROS)
        with pytest.raises(ConnectionError):
            await second.message()
    await until(lambda: (ROS, 9) not in opened.directory)
    assert headset.id not in (1, 9)
