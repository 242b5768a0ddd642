"""One TCP agent: recorded and hostile bytes in, the events of the protocol out, at the times that were agreed."""

from __future__ import annotations

import json
import re
import tracemalloc
from collections.abc import Iterable
from typing import Any, NamedTuple

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from macs_zenoh.errors import (
    BadField,
    BadJson,
    BadSizes,
    FrameTooLarge,
    NotAdmitted,
    NotAllowed,
    NotPermitted,
    TooFast,
    UnknownManager,
    WireError,
)
from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.halts import HALTS_PER_S
from macs_zenoh.protocol.messages import (
    MANAGERS,
    OPERATOR,
    ROS,
    UNITY,
    AddNode,
    AgentsGone,
    Configuration,
    Functionality,
    FunctionalityRequest,
    GoOffline,
    Heartbeat,
    Management,
    Metadata,
    NodeRefused,
    OnlineRequest,
    Registration,
    RemoveNode,
    StreamData,
    Welcome,
    encode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.recency import QUESTIONS
from macs_zenoh.protocol.rights import Grant, Rights
from macs_zenoh.protocol.tcp_agent import (
    Answered,
    Asked,
    AskedOnline,
    Event,
    Forbidden,
    Joined,
    Left,
    Limits,
    Registering,
    RegistrationRefused,
    Rejected,
    Sent,
    State,
    Streamed,
    TcpAgent,
    Withdrawn,
)
from macs_zenoh.protocol.wire import MACS, Layout, encode_frame, encode_message, parse_frame, split_message
from tests.support.recordings import BY_NAME, RECORDINGS, Recording, one_by_one, reading
from tests.support.thorough import examples

LIMITS = Limits(max_frame_bytes=1 << 20, handshake_timeout_s=10.0, idle_timeout_s=5.0, held_frames=4, held_bytes=1000)


def configuration(agent_type: int = UNITY, agent_id: int = 7, group: int = 0, request_id: int = 42) -> bytes:
    """The answer to a welcome."""
    return encode_frame(management=encode_management(Configuration(agent_type, agent_id, group, request_id)))


def message(*, sender: tuple[int, int] = (UNITY, 7), data: bytes = b"hi", ids: Iterable[int] = (5,)) -> bytes:
    """A message to some headsets."""
    metadata = Metadata(*sender, node_type=2, node_name="nd__talk").encode()
    return encode_frame(UNITY, tuple(ids), message=encode_message(metadata, data))


def online(agent_type: int = UNITY, group: int = 0, limits: Limits = LIMITS) -> TcpAgent:
    """Agent 7, configured at time 0."""
    peer = TcpAgent(7, 42, 0.0, limits=limits)
    peer.receive(configuration(agent_type, group=group), 0.0)
    assert peer.state is State.ONLINE
    return peer


def errors(events: list[Event]) -> list[type[WireError]]:
    """What was wrong with the rejected frames."""
    return [type(event.error) for event in events if isinstance(event, Rejected)]


def singles(events: Iterable[Event]) -> list[Event]:
    """The events with every run of frames taken apart."""
    taken: list[Event] = []
    for event in events:
        taken += [Sent(frame, event.metadata) for frame in event.frame.each()] if isinstance(event, Sent) else [event]
    return taken


def said(event: Event) -> tuple[Any, ...]:
    """An event in plain values."""
    if isinstance(event, Sent):
        header = event.frame.header
        return "Sent", header.agent_type, header.ids, header.groups, bytes(event.frame.body)
    if isinstance(event, Streamed):
        return "Streamed", event.metadata.node_name, event.targets, bytes(event.frame.body)
    if isinstance(event, Joined):
        return "Joined", event.agent_type, event.group
    if isinstance(event, Registering):
        node = event.node
        return (
            "Registering",
            node.manager,
            (node.registrant_agent_type, node.registrant_agent_id),
            (node.node_type, node.node_name),
            event.robot_ids,
            event.groups,
        )
    if isinstance(event, Rejected):
        return "Rejected", type(event.error).__name__
    return ("AskedOnline", event.request_id) if isinstance(event, AskedOnline) else ("Left",)


# -- recordings ------------------------------------------------------------------------------------------------------


class Talk(NamedTuple):
    """What one agent sent in one recording. When it was configured in an earlier one, that comes first."""

    name: str
    agent_id: int
    stream: list[bytes]


def own_id(recording: Recording, connection: str, frames: list[bytes]) -> int:
    """The id of a connection: from its name, else what a good agent says of itself; 7 in headset recordings."""
    if named := re.search(r"\(id (\d+)", connection):
        return int(named.group(1))
    parts = [part for frame in map(parse_frame, frames) for part in (frame.management, frame.metadata) if part]
    said_ids = [fields.get("agent_id") or fields.get("sender_agent_id") for fields in map(reading, parts)]
    return next(filter(None, said_ids), 7) if recording.name.startswith("router/") else 7


def talks(recordings: list[Recording]) -> list[Talk]:
    """Every connection of some recordings."""
    found = []
    for recording in recordings:
        for connection in dict.fromkeys(row.connection for row in recording.rows if row.sent):
            frames = [row.data for row in recording.rows if row.sent and row.connection == connection]
            agent_id = own_id(recording, connection, frames)
            if not recording.is_fault and not any(b"AgentclientConfigurer" in data for data in frames):
                group = re.search(r"group (\d+)", connection)
                agent_type = ROS if connection.startswith("ros") else UNITY
                frames.insert(0, configuration(agent_type, agent_id, int(group.group(1)) if group else 0))
            found.append(Talk(f"{recording.name}: {connection or 'headset'}", agent_id, frames))
    return found


def expected(talk: Talk) -> list[tuple[Any, ...]]:
    """The events of a talk without faults, by the protocol page and Python's own JSON."""
    events: list[tuple[Any, ...]] = []
    agent_type = 0
    for data in talk.stream:
        frame = parse_frame(data)
        fields = reading(frame.management) if frame.management else {}
        metadata = reading(frame.metadata) if frame.metadata else {}
        match fields.get("message_manager"):
            case None:
                header = frame.header
                events.append(("Sent", header.agent_type, header.ids, header.groups, bytes(frame.body)))
            case "AgentclientConfigurer":
                agent_type = fields["agent_type"]
                events.append(("Joined", agent_type, fields["group_id"]))
            case "OnlineAgentsGetter":
                events.append(("AskedOnline", metadata["request_id"]))
            case "UnityAgentclientRemover":
                events.append(("Left",))
            case "RosAgentSubscriberDataForwarder":
                targets = [(int(kind), i) for kind, ids in fields["dest_agents"].items() for i in ids]
                events.append(("Streamed", metadata["node_name"], targets, bytes(frame.body)))
            case "RosAgentNodeRegistrationForwarder":
                events.append(
                    (
                        "Registering",
                        metadata["message_manager"],
                        (agent_type, talk.agent_id),
                        (fields["node_type"], fields["node_name"]),
                        fields["registrar_agent_ids"],
                        fields["registrar_group_ids"],
                    )
                )
            case manager:
                assert manager == "HeartbeatHandler"
    return events


GOOD_TALKS = talks([recording for recording in RECORDINGS if not recording.is_fault and recording.frames])


@pytest.mark.parametrize("talk", GOOD_TALKS, ids=lambda talk: talk.name)
def test_a_recorded_agent_does_what_the_protocol_says(talk: Talk) -> None:
    """What existing agents were recorded to send gives exactly the events that the protocol page says, however the
    bytes are cut; nothing is rejected, and every message leaves with the connection's own id as its sender."""
    stream = b"".join(talk.stream)
    whole = TcpAgent(talk.agent_id, 42, 0.0)
    events = whole.receive(stream, 1.0)
    assert [said(event) for event in events] == expected(talk)
    assert not whole.drops
    for event in events:
        if isinstance(event, Sent | Streamed):
            sender = reading(event.frame.metadata)
            assert (sender["sender_agent_type"], sender["sender_agent_id"]) == (whole.agent_type, talk.agent_id)
            assert Metadata.decode(event.frame.metadata) == event.metadata
    piecewise = TcpAgent(talk.agent_id, 42, 0.0)
    assert [said(event) for piece in one_by_one(stream) for event in piecewise.receive(piece, 1.0)] == expected(talk)


def test_the_recordings_show_every_event_of_a_good_agent() -> None:
    """The recorded talks join, send, stream, register, ask and leave, robots as well as headsets."""
    shown = {(event[0], talk.name.partition(": ")[2][:3]) for talk in GOOD_TALKS for event in expected(talk)}
    kinds = {kind for kind, _ in shown}
    assert kinds == {"Joined", "Sent", "Streamed", "Registering", "AskedOnline", "Left"}
    assert {("Sent", "ros"), ("Streamed", "ros"), ("Joined", "ros")} <= shown


NEXT = ("Sent", 2, (2,), ())
FAULTS: dict[str, list[list[tuple[Any, ...]]]] = {
    "configure_snake_case_keys": [[("Joined", 2, 0)], [("Joined", 2, 0), ("AskedOnline", 0)]],
    "configure_twice": [[("Joined", 2, 0), NEXT], [("Joined", 2, 0)]],
    "configure_type7": [[("Joined", 7, 0)], [("Joined", 2, 0), ("AskedOnline", 0)]],
    "configure_upper_camel_keys": [[("Joined", 2, 0)], [("Joined", 2, 0), ("AskedOnline", 0)]],
    "fragmented_and_coalesced": [[("Joined", 2, 0), NEXT, NEXT, NEXT, NEXT], [("Joined", 2, 0)]],
    "inner_size_lie": [[("Joined", 2, 0), ("Rejected", "BadSizes"), NEXT], [("Joined", 2, 0)]],
    "kick_other_agent": [[("Joined", 2, 0)], [("Joined", 2, 0), ("Rejected", "NotAllowed"), ("AskedOnline", 0)]],
    "lying_agent_id": [[("Joined", 2, 0)], [("Joined", 2, 0)], [("Joined", 2, 0), ("Sent", 2, (1,), ())]],
    "lying_agent_type": [[("Joined", 1, 9)], [("Joined", 2, 0), ("AskedOnline", 0)]],
    "mgmt_bad_json": [[("Joined", 2, 0), ("Rejected", "BadJson"), NEXT], [("Joined", 2, 0)]],
    "mgmt_with_dest_not_forwarded": [[("Joined", 2, 0)], [("Joined", 2, 0)]],
    "mgmt_without_messageManager": [[("Joined", 2, 0), ("Rejected", "BadField"), NEXT], [("Joined", 2, 0)]],
    "online_agents_for_other": [[("Joined", 2, 0), ("AskedOnline", 5)], [("Joined", 2, 0)]],
    "remove_unknown_id": [[("Joined", 2, 0), ("Rejected", "NotAllowed"), NEXT], [("Joined", 2, 0)]],
    "subscriber_forwarder_from_headset": [[("Joined", 2, 0), ("Rejected", "NotAllowed")], [("Joined", 2, 0)]],
    "unconfigured_sender": [[], [("Joined", 2, 0)]],
    "unknown_message_manager": [[("Joined", 2, 0), NEXT, ("Rejected", "UnknownManager"), NEXT], [("Joined", 2, 0)]],
    "zero_ids_between": [[("Joined", 2, 0), ("Sent", 2, (2, 2), ())], [("Joined", 2, 0)]],
    "zero_size_message": [[("Joined", 2, 0), ("Rejected", "BadSizes"), NEXT], [("Joined", 2, 0)]],
}
"""What bad input costs here: by recording, the events of connection 1, 2, 3. The bodies of messages are left out."""


@pytest.mark.parametrize("name", [recording.name for recording in RECORDINGS if recording.is_fault])
def test_a_recorded_fault_costs_one_frame(name: str) -> None:
    """Input that broke the existing router costs the one bad frame: the connection goes on, each keeps its own id."""
    found = sorted(talks([BY_NAME[name]]), key=lambda talk: talk.agent_id)
    assert [talk.agent_id for talk in found] == list(range(1, len(found) + 1))
    for talk, events in zip(found, FAULTS[name.removeprefix("router/fault_")], strict=True):
        for pieces in ([b"".join(talk.stream)], one_by_one(b"".join(talk.stream))):
            peer = TcpAgent(talk.agent_id, talk.agent_id, 0.0)
            got = [said(event) for piece in pieces for event in singles(peer.receive(piece, 1.0))]
            assert [event[:4] if event[0] == "Sent" else event for event in got] == events
            assert peer.agent_id == talk.agent_id
            assert peer.state is not State.GONE
            assert sum(peer.drops.values()) == sum(event[0] == "Rejected" for event in events)


# -- joining ---------------------------------------------------------------------------------------------------------


def test_the_welcome_is_the_recorded_one() -> None:
    """The first message tells the id, with the connection's number as its request, as the existing router does."""
    recorded = BY_NAME["headset/handshake_group0"].messages[0]
    metadata, data = split_message(TcpAgent(7, 42, 0.0).welcome())
    expected_metadata, expected_data = split_message(recorded)
    assert reading(metadata) == reading(expected_metadata)
    assert json.loads(bytes(data)) == json.loads(bytes(expected_data)) == {"agentId": 7}


def test_registrations_before_the_configuration_wait_for_it() -> None:
    """What headsets send before their configuration follows their joining, in order, with the id they were given."""
    frames = BY_NAME["headset/register"].frames
    peer = TcpAgent(9, 42, 0.0, limits=LIMITS._replace(held_frames=256, held_bytes=1 << 20))
    assert peer.receive(b"".join(frames), 1.0) == []
    assert peer.state is State.GREETED
    joined, *registered = peer.receive(BY_NAME["headset/handshake_group3"].frames[0], 2.0)
    assert said(joined) == ("Joined", UNITY, 3)
    assert [said(event)[2] for event in registered] == [(UNITY, 9)] * len(frames)
    names = [reading(parse_frame(frame).management)["node_name"] for frame in frames]
    assert [said(event)[3][1] for event in registered] == names
    assert not peer.drops


def test_messages_before_the_configuration_wait_for_it() -> None:
    """A message sent too early is delivered after joining, with its true sender."""
    peer = TcpAgent(7, 42, 0.0, limits=LIMITS)
    assert peer.receive(message(sender=(UNITY, 0)), 1.0) == []
    joined, sent = peer.receive(configuration(), 2.0)
    assert isinstance(joined, Joined)
    assert isinstance(sent, Sent)
    assert (sent.metadata.sender_agent_id, peer.corrected) == (7, 1)


def test_bad_frames_that_waited_are_rejected_after_joining() -> None:
    """A held frame that cannot be used costs itself; those held behind it are still delivered."""
    peer = TcpAgent(7, 42, 0.0, limits=LIMITS)
    no_metadata = encode_frame(UNITY, [5], message=encode_message(b"", b"x"))
    assert peer.receive(no_metadata + message(), 1.0) == []
    assert [said(event)[0] for event in singles(peer.receive(configuration(), 2.0))] == ["Joined", "Rejected", "Sent"]


def test_what_may_wait_for_the_configuration_is_bounded() -> None:
    """Frames beyond the number or the bytes that may be held are dropped and counted, the first ones kept."""
    for frames, kept in (([message()] * 6, 4), ([message(data=bytes(400))] * 3, 1)):
        peer = TcpAgent(7, 42, 0.0, limits=LIMITS)
        peer.receive(b"".join(frames), 1.0)
        assert peer.drops == {"before_configuration": len(frames) - kept}
        assert [said(event)[0] for event in singles(peer.receive(configuration(), 2.0))] == ["Joined"] + [
            "Sent"
        ] * kept


@pytest.mark.parametrize(("agent_id", "request_id"), [(0, 42), (999, 42), (7, 1), (7, 0)])
def test_the_id_in_a_configuration_is_not_believed(agent_id: int, request_id: int) -> None:
    """Whatever id and request a configuration names, the agent has the id it was given."""
    peer = TcpAgent(7, 42, 0.0)
    assert peer.receive(configuration(UNITY, agent_id, 3, request_id), 1.0) == [Joined(UNITY, 3, None)]
    (sent,) = peer.receive(message(), 2.0)
    assert isinstance(sent, Sent)
    assert sent.metadata.sender_agent_id == peer.agent_id == 7


def test_nobody_becomes_an_operator_over_tcp() -> None:
    """Who calls itself an operator does not get online: a robot that lets operators release it knows who they are."""
    peer = TcpAgent(7, 42, 0.0)
    assert errors(peer.receive(configuration(OPERATOR), 1.0)) == [NotAllowed]
    assert peer.state is State.GREETED
    assert peer.receive(configuration(UNITY), 2.0) == [Joined(UNITY, 0, None)]


def test_a_second_configuration_may_change_the_group() -> None:
    """The same configuration again is nothing; another group is told; another type is refused and nothing changes."""
    peer = online(group=3)
    assert peer.receive(configuration(group=3, request_id=1), 1.0) == []
    assert peer.receive(configuration(group=5), 1.0) == [Joined(UNITY, 5, None)]
    assert errors(peer.receive(configuration(ROS), 1.0)) == [NotAllowed]
    assert (peer.state, peer.agent_type, peer.group) == (State.ONLINE, UNITY, 5)


def test_type_0_is_no_agent() -> None:
    """Nobody can join as the type that means everybody; a proper configuration still can follow."""
    peer = TcpAgent(7, 42, 0.0)
    assert errors(peer.receive(configuration(0), 1.0)) == [BadField]
    assert peer.state is State.GREETED
    assert peer.receive(configuration(), 1.0) == [Joined(UNITY, 0, None)]


def test_a_robot_tells_what_it_offers() -> None:
    """The functionality in a robot's configuration is part of its joining."""
    offers = Functionality(publishers={"/cmd_vel": "geometry_msgs/msg/Twist"})
    raw = encode_management(Configuration(ROS, 7, 0, 42, offers))
    peer = TcpAgent(7, 42, 0.0)
    assert peer.receive(encode_frame(management=raw), 1.0) == [Joined(ROS, 0, offers)]
    assert peer.functionality == offers


def test_a_later_configuration_may_change_what_a_robot_offers() -> None:
    """What a robot says last is kept, also when nothing else has changed; saying nothing takes nothing back."""
    peer = online(ROS)
    offers = Functionality(services={"/set": "std_srvs/srv/SetBool"})
    for functionality in (offers, None):
        raw = encode_management(Configuration(ROS, 7, 0, 42, functionality))
        assert peer.receive(encode_frame(management=raw), 1.0) == []
        assert peer.functionality == offers


def test_who_does_not_say_that_it_is_newer_is_an_existing_program() -> None:
    """An agent understands the extensions that its last configuration names, and none without a word of them."""
    peer = online()
    assert peer.extensions == 0
    peer.receive(encode_frame(management=encode_management(Configuration(UNITY, 7, extensions=1))), 1.0)
    assert peer.extensions == 1
    peer.receive(configuration(), 2.0)
    assert peer.extensions == 0


@pytest.mark.parametrize("extensions", ["-1", "65536", "1.5", '"1"', "null", "[]", "true"])
def test_a_version_that_is_none_is_refused(extensions: str) -> None:
    """Extensions are a number from 0 to 65535; anything else costs the configuration."""
    raw = b'{"messageManager":"AgentclientConfigurer","agentType":2,"agentId":7,"extensions":%s}' % extensions.encode()
    assert errors(TcpAgent(7, 42, 0.0).receive(encode_frame(management=raw), 1.0)) == [BadField]


# -- leaving ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("agent_id", [7, 0])
@pytest.mark.parametrize("configured", [True, False])
def test_an_agent_may_go_offline(agent_id: int, configured: bool) -> None:
    """An agent that says it goes offline has left, and nothing it sent behind that counts."""
    peer = online() if configured else TcpAgent(7, 42, 0.0, limits=LIMITS)
    events = peer.receive(encode_frame(management=encode_management(GoOffline(agent_id))) + message(), 1.0)
    assert [type(event) for event in events] == [Left]
    assert peer.state is State.GONE
    assert peer.receive(message() + configuration(), 1.0) == []
    assert peer.tick(1e9) == []


def test_another_id_holds_from_then_on() -> None:
    """After a change of id the agent is told it, its answer changes nothing else, what it still writes with the old id
    is corrected, and it may go offline under either."""
    for goodbye in (7, 300, 0):
        peer = online()
        (sent,) = peer.receive(message(), 1.0)
        assert isinstance(sent, Sent)
        assert sent.metadata.sender_agent_id == 7
        peer.renumber(300)
        metadata, data = split_message(peer.welcome())
        assert Metadata.decode(metadata).message_manager == Welcome.manager
        assert json.loads(bytes(data)) == {"agentId": 300}
        assert peer.receive(configuration(agent_id=300), 1.0) == []
        (sent,) = peer.receive(message(), 1.0)
        assert isinstance(sent, Sent)
        assert Metadata.decode(sent.frame.metadata).sender_agent_id == 300
        (left,) = peer.receive(encode_frame(management=encode_management(GoOffline(goodbye))), 1.0)
        assert isinstance(left, Left)


def test_nobody_sends_another_agent_offline() -> None:
    """Going offline in another agent's name is refused; both stay."""
    peer = online()
    assert errors(peer.receive(encode_frame(management=encode_management(GoOffline(8))), 1.0)) == [NotAllowed]
    assert peer.state is State.ONLINE


def test_a_lost_connection_says_nothing_more() -> None:
    """After the socket is gone there are no events, neither from bytes nor from time."""
    peer = online()
    peer.lost()
    assert peer.receive(message(), 1.0) == []
    assert peer.tick(1e9) == []


def test_who_does_not_answer_the_welcome_leaves() -> None:
    """Without a configuration the connection ends when the handshake limit is over, whatever else was sent."""
    peer = TcpAgent(7, 42, 100.0, limits=LIMITS)
    peer.receive(message(), 109.0)
    assert peer.next_deadline() == 110.0
    assert peer.tick(109.9) == []
    assert [type(event) for event in peer.tick(110.0)] == [Left]
    assert peer.tick(111.0) == []


def test_who_is_silent_leaves() -> None:
    """An agent is gone when nothing was heard of it for the agreed time; any byte of it starts that time anew."""
    peer = online()
    assert peer.next_deadline() == 5.0
    peer.receive(message()[:1], 4.0)
    assert peer.next_deadline() == 9.0
    assert peer.tick(8.9) == []
    assert [type(event) for event in peer.tick(9.0)] == [Left]
    assert peer.state is State.GONE


# -- sending ---------------------------------------------------------------------------------------------------------


def test_a_true_message_is_not_touched() -> None:
    """A message whose sender is right goes on as the bytes that came, also when it is sent many times."""
    peer = online()
    raw = message()
    events = peer.receive(raw * 3, 1.0)
    assert [bytes(event.frame.data) for event in singles(events) if isinstance(event, Sent)] == [raw] * 3
    assert peer.corrected == 0


@pytest.mark.parametrize("sender", [(UNITY, 0), (UNITY, 8), (ROS, 7), (None, None)])
def test_a_false_sender_is_put_right(sender: tuple[int, int]) -> None:
    """A message in another's name goes on in the sender's own, with everything else in it as it was; it is counted."""
    peer = online()
    metadata = {"new": [1], **json.loads(Metadata(*sender, request_id=9, node_name="n").encode())}
    raw = encode_frame(UNITY, [5, 6], [1], message=encode_message(json.dumps(metadata).encode(), b"\0\1\2"))
    for event in singles(peer.receive(raw * 2, 1.0)):
        assert isinstance(event, Sent)
        frame = event.frame
        assert json.loads(frame.metadata) == {**metadata, "senderAgentType": UNITY, "senderAgentId": 7}
        assert (frame.header.ids, frame.header.groups, bytes(frame.body)) == ((5, 6), (1,), b"\0\1\2")
        assert (event.metadata.sender_agent_id, event.metadata.request_id) == (7, 9)
    assert peer.corrected == 2


@pytest.mark.parametrize(
    "spelling", ["SenderAgentType SenderAgentId NodeName", "sender_agent_type sender_agent_id node_name"]
)
def test_metadata_goes_on_in_camel_case(spelling: str) -> None:
    """A message whose metadata is spelled in another way reaches its receiver in the one that existing agents read."""
    metadata = dict(zip(spelling.split(), (UNITY, 7, "nd_x"), strict=True))
    (event,) = online().receive(encode_frame(UNITY, [5], message=encode_message(json.dumps(metadata).encode())), 1.0)
    assert isinstance(event, Sent)
    assert json.loads(event.frame.metadata) == {"senderAgentType": UNITY, "senderAgentId": 7, "nodeName": "nd_x"}
    assert event.metadata.node_name == "nd_x"


@pytest.mark.parametrize("key", ["SenderAgentId", "sender_agent_id"])
def test_a_false_sender_cannot_hide_behind_the_true_one(key: str) -> None:
    """Metadata that names the true sender and, in another spelling, a false one leaves with the true one only."""
    metadata = b'{"senderAgentType":2,"senderAgentId":7,"%s":8}' % key.encode()
    (event,) = online().receive(encode_frame(UNITY, [5], message=encode_message(metadata)), 1.0)
    assert isinstance(event, Sent)
    assert reading(event.frame.metadata)["sender_agent_id"] == 7


@pytest.mark.parametrize(
    ("metadata", "error"),
    [
        (b"", BadField),
        (b"{", BadJson),
        (b"[]", BadJson),
        (b'{"nodeName":null}', BadField),
        (b'{"requestId":-1}', BadField),
        pytest.param(
            b'{"senderAgentType":2,"senderAgentId":7,"new":"\xff"}',
            BadJson,
        ),
        pytest.param(
            b'{"new":' + b"[" * 2000 + b"]" * 2000 + b"}",
            BadJson,
        ),
    ],
)
def test_a_message_that_would_make_its_receiver_deaf_is_rejected(metadata: bytes, error: type[WireError]) -> None:
    """Metadata that is missing, no JSON, or of wrong types reaches nobody; the sender stays."""
    peer = online()
    assert errors(peer.receive(encode_frame(UNITY, [5], message=encode_message(metadata)), 1.0)) == [error]
    assert peer.drops == {error.__name__: 1}
    assert [said(event)[0] for event in singles(peer.receive(message(), 1.0))] == ["Sent"]


def test_long_metadata_is_forgotten() -> None:
    """Metadata that an agent makes up costs memory only while its frame is read."""
    peer = online()
    raws = [
        encode_frame(UNITY, [5], message=encode_message(b'{"new":"%d%s"}' % (number, b"x" * 4000)))
        for number in range(600)
    ]
    tracemalloc.start()
    try:
        for raw in raws:
            assert len(peer.receive(raw, 1.0)) == 1
        assert tracemalloc.get_traced_memory()[0] < 1_000_000
    finally:
        tracemalloc.stop()


# -- management ------------------------------------------------------------------------------------------------------


def test_who_is_online_is_asked_for_oneself() -> None:
    """The question is this connection's, whatever agent it names; without metadata its request id is 0."""
    metadata = Metadata(UNITY, 7, request_id=3).encode()
    for message_, request_id in ((encode_message(metadata), 3), (encode_message(b""), 0)):
        raw = encode_frame(management=encode_management(OnlineRequest(UNITY, 99)), message=message_)
        assert online().receive(raw, 1.0) == [AskedOnline(request_id)]


@pytest.mark.parametrize("node", [AddNode(1, 99, 1, "nd_x", "x", "T"), RemoveNode(1, 99, 1, "nd_x")])
def test_a_registration_is_made_in_ones_own_name(node: AddNode | RemoveNode) -> None:
    """The registrant of a registration is the connection's agent, whoever the JSON names."""
    management = encode_management(Registration(99, 1, "nd_x", [1, 2], [3]))
    metadata = Metadata(UNITY, 99, message_manager=node.manager).encode()
    raw = encode_frame(ROS, management=management, message=encode_message(metadata, encode_data(node)))
    peer = online()
    (event,) = peer.receive(raw, 1.0)
    assert said(event) == ("Registering", node.manager, (UNITY, 7), (1, "nd_x"), [1, 2], [3])
    assert peer.corrected == 1


@pytest.mark.parametrize(
    ("metadata", "body", "error"),
    [
        (b"", b"{}", BadField),
        (Metadata().encode(), b"{}", BadField),
        (Metadata(message_manager="GoneAgent").encode(), b"{}", BadField),
        (Metadata(message_manager=AddNode.manager).encode(), b"{}", BadField),
        (Metadata(message_manager=AddNode.manager).encode(), b"", BadJson),
        (Metadata(message_manager=RemoveNode.manager).encode(), b"[]", BadJson),
    ],
)
def test_a_registration_without_its_node_is_rejected(metadata: bytes, body: bytes, error: type[WireError]) -> None:
    """A registration whose message is neither adding nor removing a node, or not readable as that, is rejected."""
    raw = encode_frame(management=encode_management(Registration(7, 1, "n")), message=encode_message(metadata, body))
    assert errors(online().receive(raw, 1.0)) == [error]


def test_only_robots_stream() -> None:
    """Topic data goes to its registrants by type when it comes from a robot, and to nobody from anyone else."""
    management = encode_management(StreamData({"2": [1, 2, 300], "1": [], "x": [4]}))
    metadata = Metadata(ROS, 7, node_type=1, node_name="nd_x").encode()
    raw = encode_frame(ROS, management=management, message=encode_message(metadata, b"cdr"))
    (event,) = online(ROS).receive(raw, 1.0)
    assert isinstance(event, Streamed)
    assert event.targets == [(2, 1), (2, 2), (2, 300)]
    assert bytes(event.frame.data) == raw
    assert errors(online(UNITY).receive(raw, 1.0)) == [NotAllowed]


def test_a_type_of_many_digits_is_nobody() -> None:
    """A registrant type that is no type is left out or rejected, however long it is."""
    management = encode_management(StreamData({"1" * 5000: [1], "2": [1]}))
    raw = encode_frame(management=management, message=encode_message(Metadata(ROS, 7, node_name="n").encode()))
    events = online(ROS).receive(raw, 1.0)
    assert [said(event)[0] for event in events] in (["Streamed"], ["Rejected"])


@pytest.mark.parametrize(
    "value",
    [
        Welcome(7),
        AgentsGone([]),
        AddNode(UNITY, 7, 1, "n", "n", "T"),
        RemoveNode(UNITY, 7, 1, "n"),
        NodeRefused(1, 1, "n", "n", "no"),
        FunctionalityRequest(),
    ],
    ids=lambda value: type(value).__name__,
)
def test_management_data_that_is_not_for_agents_to_send_is_refused(value: Management) -> None:
    """An agent cannot say what routers say, nor name a robot's managers outside a registration."""
    raw = encode_frame(UNITY, [5], management=encode_management(value), message=encode_message(b"{}", b"x"))
    assert errors(online().receive(raw, 1.0)) == [NotAllowed]


class Battery(msgspec.Struct):
    """Data of a manager that somebody added."""

    percent: int


def test_an_added_manager_is_asked_once_the_agent_is_there() -> None:
    """Management data of a manager that was added is told with its request id, after joining."""
    raw = encode_frame(
        management=b'{"messageManager":"Battery","percent":5}',
        message=encode_message(Metadata(UNITY, 7, request_id=3).encode()),
    )
    peer = TcpAgent(7, 42, 0.0, custom={"Battery": Battery})
    assert peer.receive(raw, 1.0) == []
    assert peer.receive(configuration(), 2.0) == [Joined(UNITY, 0, None), Asked("Battery", Battery(5), 3)]
    assert errors(online().receive(raw, 1.0)) == [UnknownManager]


# -- rate ------------------------------------------------------------------------------------------------------------


def count_sent(peer: TcpAgent, frames: int, now: float) -> int:
    """How many of so many frames at once are passed on."""
    return sum(isinstance(event, Sent) for event in peer.receive(message() * frames, now))


def test_frames_beyond_the_rate_are_dropped() -> None:
    """A second's worth may come at once, then as many as time allows; what is beyond is counted."""
    peer = online(limits=LIMITS._replace(frames_per_s=10.0))
    assert count_sent(peer, 15, 0.0) == 10
    assert count_sent(peer, 5, 0.25) == 2
    assert peer.drops == {"TooFast": 8}
    assert errors(peer.receive(configuration(group=3), 0.25)) == [TooFast]
    assert peer.receive(configuration(group=3), 0.35) == [Joined(UNITY, 3, None)]
    assert count_sent(peer, 15, 4.0) == 10


def test_a_press_of_a_stop_passes_beyond_the_rate() -> None:
    """Whoever has used up his rate may still stop a robot, or say that it is to stand still, a few times a second, and
    nothing else."""

    def said(node: str, data_type: str, data: bytes) -> bytes:
        metadata = Metadata(UNITY, 7, node_type=2, node_name=node, data_exchange_type=data_type)
        return encode_frame(ROS, (1,), message=encode_message(metadata.encode(), data))

    peer = online(limits=LIMITS._replace(frames_per_s=1.0))
    count_sent(peer, 5, 0.0)
    press, release = (said("nd__emergency_stop", "std_msgs/Bool", b"\0\1\0\0" + end) for end in (b"\1", b"\0"))
    assert [type(event) for event in peer.receive(press, 0.0)] == [Sent]
    twist = b"\0\1\0\0" + bytes(40)
    moves, halts = (said("nd__cmd_vel", "geometry_msgs/Twist", twist + end) for end in (b"\1" * 8, bytes(8)))
    assert errors(peer.receive(release + moves, 0.0)) == [TooFast] * 2
    assert [type(event) for event in peer.receive(halts, 0.0)] == [Sent]
    assert 0 < sum(type(event) is Sent for event in peer.receive(halts * 100, 0.0)) < HALTS_PER_S
    assert [type(event) for event in peer.receive(press, 0.0)] == [Sent], "zeros take nothing from stops"
    assert sum(type(event) is Sent for event in peer.receive(press * 100, 0.0)) < TcpAgent.STOPS_PER_S


def test_answers_to_questions_cost_nothing_of_the_rate() -> None:
    """Who drives as fast as it may would be asked in vain; what nobody asked counts, and a second answer."""

    def answer(number: int) -> bytes:
        return encode_frame(management=encode_management(Configuration(UNITY, 7, request_id=number)))

    peer = online(limits=LIMITS._replace(frames_per_s=1.0))
    assert count_sent(peer, 3, 0.0) == 1
    first, second = QUESTIONS + 1, QUESTIONS + 2
    peer.welcome(first)
    peer.welcome(second)
    assert peer.receive(answer(first), 0.0) == [Answered(first)]
    assert errors(peer.receive(answer(first) + answer(QUESTIONS + 9), 0.0)) == [TooFast] * 2
    assert peer.receive(answer(second), 0.0) == [Answered(second)]
    credit = Credit(1.0, 0.0)
    grant = Grant("g", Rights(may=["send"], frames_per_s=1.0), credit)
    held = TcpAgent(7, 42, 0.0, limits=LIMITS, admit=lambda _: grant)
    held.receive(shown("good"), 0.0)
    assert count_sent(held, 3, 0.0) == 1
    held.welcome(first)
    assert held.receive(answer(first), 0.0) == [Answered(first)]


def test_a_slow_rate_lets_something_through() -> None:
    """With less than one frame per second allowed, one passes in each such time."""
    peer = online(limits=LIMITS._replace(frames_per_s=0.5))
    assert [count_sent(peer, 1, now) for now in (0.0, 1.0, 2.0, 3.0, 4.0)] == [1, 0, 1, 0, 1]


def registration(name: str = "nd_x", body: bytes | None = None, robots: Iterable[int] = (1,)) -> bytes:
    """A headset's registration on a node."""
    management = encode_management(Registration(7, 1, name, list(robots), tos_name="/x"))
    metadata = Metadata(UNITY, 7, message_manager=AddNode.manager).encode()
    node = encode_data(AddNode(UNITY, 7, 1, name, "/x", "std_msgs/String"))
    return encode_frame(management=management, message=encode_message(metadata, node if body is None else body))


EVERY_KIND = {
    "message": message(),
    "registration": registration(),
    "question": encode_frame(management=encode_management(OnlineRequest(UNITY, 7)), message=encode_message(b"")),
    "heartbeat": encode_frame(management=encode_management(Heartbeat())),
    "configuration": configuration(group=3),
    "no JSON": encode_frame(management=b"{"),
}


@pytest.mark.parametrize("raw", EVERY_KIND.values(), ids=EVERY_KIND)
def test_every_kind_of_frame_counts(raw: bytes) -> None:
    """Whatever an agent sends takes its credit, so that none is left for messages."""
    peer = online(limits=LIMITS._replace(frames_per_s=10.0))
    for _ in range(500):
        peer.receive(raw, 0.0)
    assert count_sent(peer, 5, 0.0) == 0
    assert peer.drops["TooFast"] >= 490
    assert count_sent(peer, 5, 1.0) == 5


def test_a_registration_beyond_the_rate_is_answered() -> None:
    """Who registers too fast hears of it, and nothing else comes of it."""
    peer = online(limits=LIMITS._replace(frames_per_s=1.0))
    assert [type(event) for event in peer.receive(registration(), 0.0)] == [Registering]
    told, rejected = peer.receive(registration("nd_y"), 0.0)
    assert isinstance(told, RegistrationRefused)
    assert (told.refused.node_name, told.refused.tos_name, told.refused.robot_id) == ("nd_y", "/x", 0)
    assert told.refused.reason == "more than 1 frames/s"
    assert errors([rejected]) == [TooFast]
    assert peer.state is State.ONLINE


def test_who_is_too_fast_may_still_leave() -> None:
    """Going offline is heard at any rate."""
    peer = online(limits=LIMITS._replace(frames_per_s=1.0))
    events = peer.receive(message() * 5 + encode_frame(management=encode_management(GoOffline(7))), 0.0)
    assert isinstance(events[-1], Left)


def test_credit_is_that_of_the_connection_before() -> None:
    """A new connection that is given spent credit has none."""
    limits = LIMITS._replace(frames_per_s=10.0)
    first = online(limits=limits)
    assert count_sent(first, 20, 0.0) == 10
    second = TcpAgent(8, 43, 0.5, limits=limits, credit=first.credit)
    second.receive(configuration(), 0.5)
    assert count_sent(second, 20, 0.5) == 5


@pytest.mark.parametrize("name", ["", "x" * 70_000, "a\x1b[2J", "a\nb"])
def test_a_registration_with_a_name_that_is_none_is_answered(name: str) -> None:
    """A name that cannot be a node's costs that frame; who sent it is told as far as it can be said."""
    peer = online()
    events = peer.receive(registration(name), 1.0)
    assert not any(isinstance(event, Registering) for event in events)
    assert len(errors(events)) == 1
    assert peer.state is State.ONLINE
    plain = registration(body=encode_data(AddNode(UNITY, 7, 1, name, "/x", "std_msgs/String")))
    told, rejected = peer.receive(plain, 1.0)
    assert isinstance(told, RegistrationRefused)
    assert told.refused.reason == str(getattr(rejected, "error", ""))[:500]


def test_a_registration_names_a_thousand_robots_at_most() -> None:
    """65 535 robots in one registration are refused; 1 024 are not."""
    peer = online(limits=LIMITS._replace(max_frame_bytes=32 << 20))
    assert [type(event) for event in peer.receive(registration(robots=range(1, 1025)), 1.0)] == [Registering]
    assert len(errors(peer.receive(registration(robots=range(1, 1026)), 1.0))) == 1
    assert len(errors(peer.receive(registration(robots=range(1, 65_536)), 1.0))) == 1
    assert peer.drops.total() == 2


# -- frames that do not end ------------------------------------------------------------------------------------------


SLOW = LIMITS._replace(max_frame_bytes=32 << 20, partial_bytes_per_s=1000.0, partial_window_s=10.0)


def drip(peer: TcpAgent, size: int, each_s: float, until_s: float, start_s: float = 0.0) -> list[Event]:
    """So many bytes of zeros in each such time, with what `tick` says in between."""
    events: list[Event] = []
    now = start_s
    while now < until_s and not events:
        now += each_s
        events += peer.receive(bytes(size), now)
        events += peer.tick(max(now, min(peer.next_deadline(), now + each_s / 2)))
    return events


@pytest.mark.parametrize("begun", [MACS.pack(2, [1], [], 0, 31 << 20) + bytes(15 << 20), MACS.pack(2, [1])[:20]])
def test_a_frame_that_does_not_go_on_ends_its_connection(begun: bytes) -> None:
    """A byte every few seconds keeps no half frame alive, nor half a header."""
    peer = online(limits=SLOW)
    assert peer.receive(begun, 0.0) == []
    events = drip(peer, 1, 4.0, 26.0)
    assert [type(event) for event in events] == [Left]
    assert peer.drops == {"unfinished_frame": 1}


def test_a_frame_that_is_slow_is_waited_for() -> None:
    """As long as enough comes of it in each window, a large frame may take its time."""
    peer = online(limits=SLOW)
    size = 200_000
    whole = encode_frame(UNITY, [5], message=encode_message(Metadata(UNITY, 7).encode(), bytes(size)))
    now = 0.0
    events: list[Event] = []
    for at in range(0, len(whole), 4000):
        now += 3.0
        events += peer.receive(whole[at : at + 4000], now) + peer.tick(now)
    assert [type(event) for event in events] == [Sent]
    assert peer.partial_bytes == 0


def test_frames_one_after_the_other_are_none_that_does_not_end() -> None:
    """An agent whose reads always end within a frame is judged frame by frame."""
    peer = online(limits=SLOW)
    stream = message() * 200
    now = 0.0
    for at in range(0, len(stream), 50):
        now += 0.5
        assert not [
            event for event in peer.receive(stream[at : at + 50], now) + peer.tick(now) if isinstance(event, Left)
        ]


def test_what_a_half_frame_costs_is_known() -> None:
    """The memory of a frame that has begun can be asked for, and is given back with its end."""
    peer = online(limits=SLOW)
    peer.receive(MACS.pack(2, [1], [], 0, 10 << 20) + bytes(5 << 20), 0.0)
    assert 5 << 20 <= peer.partial_bytes <= 10 << 20
    peer.receive(bytes(5 << 20), 1.0)
    assert peer.partial_bytes == 0


# -- hostile bytes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("configured", [True, False])
def test_4_gib_declared_cost_nothing_but_the_connection(configured: bool) -> None:
    """A header that declares 4 GiB reserves no memory; the connection ends, what came before it counts."""
    peer = online() if configured else TcpAgent(7, 42, 0.0, limits=LIMITS)
    before = message() if configured else configuration()
    raw = before + MACS.pack(1, [1], [], 0, 0xFFFFFFFF) + bytes(1000)
    tracemalloc.start()
    try:
        events = peer.receive(raw, 1.0)
        assert tracemalloc.get_traced_memory()[1] < 200_000
    finally:
        tracemalloc.stop()
    assert [said(event)[0] for event in events] == ["Sent" if configured else "Joined", "Rejected", "Left"]
    assert errors(events) == [FrameTooLarge]
    assert peer.drops == {"FrameTooLarge": 1}
    assert peer.receive(message(), 2.0) == []


def test_each_bad_frame_costs_itself() -> None:
    """Of a stream of good and bad frames in one piece the good ones count, in order; drops are counted by name."""
    peer = online()
    bad = [
        encode_frame(management=b"{"),
        encode_frame(management=b'{"messageManager":"os"}'),
        encode_frame(UNITY, [5], message=b""),
        encode_frame(UNITY, [5], message=b"\xff" * 12),
        encode_frame(management=encode_management(AgentsGone([]))),
    ]
    events = peer.receive(b"".join(frame + message(data=b"%d" % n) for n, frame in enumerate(bad)), 1.0)
    assert [bytes(event.frame.body) for event in events if isinstance(event, Sent)] == [b"0", b"1", b"2", b"3", b"4"]
    assert errors(events) == [BadJson, UnknownManager, BadSizes, BadSizes, NotAllowed]
    assert peer.drops == {"BadJson": 1, "UnknownManager": 1, "BadSizes": 2, "NotAllowed": 1}


any_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=4,
)
keys = st.sampled_from(sorted({name for kind in MANAGERS.values() for name in kind.__struct_encode_fields__}))
hostile_frames = st.builds(
    lambda agent_type, management, metadata, body, lie: encode_frame(
        agent_type, [5], management=management, message=lie or encode_message(metadata, body)
    ),
    st.integers(0, 255),
    st.just(b"")
    | st.binary(max_size=20)
    | st.builds(
        lambda fields, manager: json.dumps({**fields, "messageManager": manager}).encode(),
        st.dictionaries(keys, st.integers(0, 3) | any_json),
        st.sampled_from(sorted(MANAGERS)) | st.text(max_size=5),
    ),
    st.just(Metadata(UNITY, 7, message_manager=AddNode.manager).encode())
    | st.binary(max_size=20)
    | any_json.map(lambda value: json.dumps(value).encode()),
    st.binary(max_size=20) | any_json.map(lambda value: json.dumps(value).encode()),
    st.none() | st.none() | st.binary(max_size=20),
)


@settings(max_examples=examples(200))
@given(st.lists(hostile_frames | st.binary(max_size=100), max_size=5), st.integers(0, 2))
def test_any_bytes_give_events(frames: list[bytes], agent_type: int) -> None:
    """Whatever an agent sends there are only events: what is passed on has right sizes, readable metadata and its
    true sender, and after leaving there is nothing."""
    peer = online(agent_type) if agent_type else TcpAgent(7, 42, 0.0, limits=LIMITS)
    events = peer.receive(b"".join(frames), 1.0)
    for event in events:
        if isinstance(event, Sent | Streamed):
            sender = json.loads(event.frame.metadata)
            assert (sender["senderAgentType"], sender["senderAgentId"]) == (peer.agent_type, 7)
    assert not any(isinstance(event, Left) for event in events[:-1])
    assert (peer.state is State.GONE) == bool(events and isinstance(events[-1], Left))


def test_other_layouts_work_alike() -> None:
    """With more slots in the header an agent joins and sends, and a corrected frame keeps that layout."""
    layout = Layout(20, 20)
    peer = TcpAgent(7, 42, 0.0, layout=layout)
    joining = encode_frame(management=encode_management(Configuration(UNITY, 7)), layout=layout)
    ids = tuple(range(1, 21))
    raw = encode_frame(UNITY, ids, message=encode_message(Metadata(UNITY, 8).encode(), b"x"), layout=layout)
    joined, sent = peer.receive(joining + raw, 1.0)
    assert isinstance(joined, Joined)
    assert isinstance(sent, Sent)
    assert sent.frame.header.ids == ids
    assert sent.frame.layout == layout
    assert sent.metadata.sender_agent_id == 7


def test_a_group_that_is_not_to_be_chosen() -> None:
    """The agent comes online in no group; it may choose another one, and not this one later."""
    peer = TcpAgent(7, 42, 0.0, closed_groups={9})
    for group, got in ((9, 0), (3, 3), (9, 0)):
        events = peer.receive(configuration(group=group), 0.0)
        joined = [event for event in events if isinstance(event, Joined)]
        assert [event.group for event in joined] == [got]
        assert peer.group == got
    assert peer.drops["NotAllowed"] == 2


# -- tokens ----------------------------------------------------------------------------------------------------------


def guarded(rights: Rights | None, **options: Any) -> TcpAgent:
    """Agent 7, for whom the token "good" is good for these rights."""
    return TcpAgent(
        7, 42, 0.0, limits=LIMITS, admit=lambda shown: Grant("g", rights) if shown == "good" else None, **options
    )


def shown(token: str | None, group: int = 0, agent_type: int = UNITY) -> bytes:
    """A configuration with a token."""
    return encode_frame(management=encode_management(Configuration(agent_type, 7, group, 42, token=token)))


def node_data(name: str, ids: tuple[int, ...] = (1,), groups: tuple[int, ...] = ()) -> bytes:
    """A command to robots."""
    metadata = Metadata(UNITY, 7, node_type=2, node_name=name).encode()
    return encode_frame(ROS, ids, groups, message=encode_message(metadata, b"x"))


def registered(topic: str, ids: list[int]) -> bytes:
    """A registration to publish a topic of robots."""
    name = node_name(topic)
    added = encode_data(AddNode(UNITY, 7, 2, name, topic, "pkg/T"))
    return encode_frame(
        management=encode_management(Registration(7, 2, name, ids)),
        message=encode_message(Metadata(UNITY, 7, message_manager=AddNode.manager).encode(), added),
    )


@pytest.mark.parametrize("token", [None, "", "bad", "goo", "goodgood"])
@pytest.mark.parametrize("agent_type", [UNITY, ROS])
def test_who_shows_no_valid_token_is_out(token: str | None, agent_type: int) -> None:
    """It is told, it leaves, and nothing that it sent before or behind is passed on."""
    peer = guarded(Rights(may=["send"]))
    events = peer.receive(message() + shown(token, agent_type=agent_type) + message(), 0.0)
    assert [type(event).__name__ for event in events] == ["Rejected", "NotLetIn", "Left"]
    assert peer.state is State.GONE
    assert peer.receive(shown("good"), 1.0) == []


def test_a_stranger_may_say_little() -> None:
    """What comes before its token waits in less room than an agent's; what comes with it is an agent's already."""
    limits = LIMITS._replace(held_frames=100, held_bytes=1 << 20)
    large = encode_frame(UNITY, (5,), message=encode_message(Metadata(UNITY, 7).encode(), bytes(90_000)))
    for stranger, passed in ((True, 1), (False, 2)):
        peer = TcpAgent(7, 42, 0.0, limits=limits, admit=lambda _: Grant(), stranger=stranger)
        events = peer.receive(large + shown("good") + large, 0.0)
        assert [type(event) for event in events] == [Joined] + [Sent] * passed
        assert peer.drops["before_configuration"] == 2 - passed


def test_only_a_token_for_robots_makes_a_robot() -> None:
    """Whoever may command robots is not one."""
    assert errors(guarded(Rights(may=["see"])).receive(shown("good", agent_type=ROS), 0.0)) == [NotAdmitted]
    assert errors(guarded(Rights(may=["robot"])).receive(shown("good", agent_type=ROS), 0.0)) == []


def test_rights_hold_for_what_was_registered() -> None:
    """Data goes where its node was registered, by the name that was judged; not before, not elsewhere, and not to a
    robot that has refused the node, since another topic may have its name there."""
    peer = guarded(Rights(may=["command"], robots=[1, 2], groups=[3], topics=["/a_b"]))
    peer.receive(shown("good"), 0.0)
    assert errors(peer.receive(node_data("nd__a_b"), 0.0)) == [NotPermitted]
    assert errors(peer.receive(registered("/a/b", [1]), 0.0)) == [NotPermitted]
    assert [type(event) for event in peer.receive(registered("/a_b", [1, 2]), 0.0)] == [Registering]
    assert [type(event) for event in peer.receive(node_data("nd__a_b"), 0.0)] == [Sent]
    assert errors(peer.receive(node_data("nd__a_b", (9,)), 0.0)) == [NotPermitted]
    peer.registration_refused(NodeRefused(1, 2, "nd__a_b", "/a_b", "no such type"))
    assert errors(peer.receive(node_data("nd__a_b", (1, 2)), 0.0)) == [NotPermitted]
    assert errors(peer.receive(node_data("nd__a_b", (), (3,)), 0.0)) == [NotPermitted]
    assert errors(peer.receive(node_data("nd__a_b", (2,)), 0.0)) == []
    peer.receive(registered("/a_b", [1]), 0.0)
    assert errors(peer.receive(node_data("nd__a_b"), 0.0)) == []


def test_a_robot_that_refused_a_node_takes_it_from_no_other_of_its_group() -> None:
    """Those of a group that have not get a message by their ids, however many they are, and its sender is told of the
    one; where none of them has, it goes to the group as ever. The others are those that are in the group just then."""
    groups = {3: [1, *range(20, 35)], 4: [2]}
    rights = Rights(may=["command", "send"], robots=[1, 2], groups=[3, 4], topics=["/a_b"])
    peer = TcpAgent(7, 42, 0.0, limits=LIMITS, admit=lambda _: Grant("g", rights), members=groups.__getitem__)
    peer.receive(shown("good") + registered("/a_b", [1, 2]), 0.0)
    peer.registration_refused(NodeRefused(1, 2, "nd__a_b", "/a_b", "no such type"))
    *sent, forbidden = peer.receive(node_data("nd__a_b", (), (3,)), 0.0)
    headers = [event.frame.header for event in sent if isinstance(event, Sent)]
    assert [header.ids for header in headers] == [tuple(range(20, 30)), tuple(range(30, 35))]
    assert not any(header.groups for header in headers)
    assert isinstance(forbidden, Forbidden)
    assert forbidden.robots == (1,)
    assert [type(event) for event in peer.receive(node_data("nd__a_b", (), (4,)), 0.0)] == [Sent]
    groups[4].append(1)
    (sent_on, _) = peer.receive(node_data("nd__a_b", (), (4,)), 0.0)
    assert isinstance(sent_on, Sent)
    assert sent_on.frame.header.ids == (2,)
    groups[4] = [1]
    assert errors(peer.receive(node_data("nd__a_b", (), (4,)), 0.0)) == [NotPermitted]
    assert errors(peer.receive(node_data("nd__a_b", (1,), (3,)), 0.0)) == [NotPermitted]
    groups[3].remove(1)
    assert [type(event) for event in peer.receive(node_data("nd__a_b", (), (3,)), 0.0)] == [Sent]


def test_changed_rights_take_back_what_they_do_not_permit() -> None:
    """Registrations, the group and what was remembered as permitted end with the right to them."""
    peer = guarded(Rights(may=["command"], robots=[1], groups=[3]))
    peer.receive(shown("good", group=3) + registered("/talk", [1]) + node_data("nd__talk"), 0.0)
    assert peer.group == 3
    events = peer.rights_change(Grant("g", Rights(may=["command"], robots=[2])))
    assert [type(event) for event in events] == [Withdrawn, Joined]
    assert (peer.group, peer.agent_type) == (0, UNITY)
    assert errors(peer.receive(node_data("nd__talk"), 0.0)) == [NotPermitted]
    assert peer.rights_change(Grant("g", Rights(may=["see"], robots=[2]))) == []


def test_a_robot_that_refused_the_node_of_its_stop_can_be_stopped() -> None:
    """A press needs no interface node: who may stop may do so where he may not register, as without a token."""
    peer = guarded(Rights(may=["stop"], robots=[1]))
    peer.receive(shown("good") + registered("/emergency_stop", [1]), 0.0)
    peer.registration_refused(NodeRefused(1, 2, "nd__emergency_stop", "/emergency_stop", "not allowed"))
    assert errors(peer.receive(node_data("nd__emergency_stop", (1,)), 0.0)) == []


def test_a_robot_whose_token_makes_it_none_any_more_leaves() -> None:
    """It came in by a right that its token has lost."""
    peer = guarded(Rights(may=["robot"]))
    peer.receive(shown("good", agent_type=ROS), 0.0)
    assert peer.rights_change(Grant("g", Rights(may=["robot", "see"]))) == []
    assert [type(event).__name__ for event in peer.rights_change(Grant("g", Rights(may=["see"])))] == ["Left"]
    assert peer.state is State.GONE


def test_what_is_told_of_a_node_names_its_topic() -> None:
    """As it was registered, since two topics may share a node's name; of a node that was not there is none to name."""
    peer = guarded(Rights(may=["command"], robots=[1]))
    peer.receive(shown("good") + registered("/a/b", [1]), 0.0)
    assert peer.topic_of(2, "nd__a_b") == "/a/b"
    assert peer.topic_of(1, "nd__a_b") == ""
    assert peer.topic_of(2, "nd__other") == ""


def test_a_robots_token_makes_no_headset() -> None:
    """Neither when it is shown nor when a headset's token becomes one."""
    peer = guarded(Rights(may=["robot", "send"]))
    assert errors(peer.receive(shown("good"), 0.0)) == [NotAdmitted]
    headset = guarded(Rights(may=["see"]))
    headset.receive(shown("good"), 0.0)
    assert [type(event).__name__ for event in headset.rights_change(Grant("g", Rights(may=["robot"])))] == ["Left"]


def test_a_group_of_others_is_not_to_be_chosen() -> None:
    """Who asks for a group that its token does not name is in none, and is told."""
    peer = guarded(Rights(groups=[3]))
    events = peer.receive(shown("good", group=4), 0.0)
    assert [type(event) for event in events] == [Rejected, Forbidden, Joined]
    assert peer.group == 0


def test_all_who_have_a_token_share_its_rate() -> None:
    """Two connections with one token may together send what it says."""
    credit = Credit(3.0, 0.0)
    grant = Grant("g", Rights(may=["send"], frames_per_s=3.0), credit)
    peers = [TcpAgent(number, 42, 0.0, limits=LIMITS, admit=lambda _: grant) for number in (7, 8)]
    for peer in peers:
        peer.receive(shown("good"), 0.0)
    events = [event for peer in peers for _ in range(4) for event in peer.receive(message(), 0.0)]
    assert len([event for event in events if isinstance(event, Sent)]) == 3
    assert errors(events) == [TooFast] * 5


def test_who_floods_robots_is_not_read() -> None:
    """Of what it sends them, commands are counted and not parsed; what may stop one passes, and all that is none."""
    peer = online()

    def said(to: int, node_type: int, data_type: str) -> bytes:
        metadata = Metadata(UNITY, 7, node_type=node_type, node_name="nd__x", data_exchange_type=data_type)
        return encode_frame(to, (5,), message=encode_message(metadata.encode(), b"12345"))

    dropped = said(ROS, 2, "std_msgs/String")
    passing = [
        *(said(ROS, 2, kind) for kind in ("std_msgs/Bool", "geometry_msgs/Twist", "geometry_msgs/msg/TwistStamped")),
        *(said(ROS, 3, "std_srvs/Trigger"), said(UNITY, 2, "std_msgs/String"), said(0, 2, "std_msgs/String")),
    ]
    for floods in (False, True, False):
        peer.floods = floods
        sent = singles(peer.receive(b"".join([dropped, *passing, dropped, dropped]), 1.0))
        assert all(isinstance(event, Sent) for event in sent)
        assert len(sent) == len(passing) + 3 * (not floods)
    assert peer.drops == {"flooded": 3}
    peer.floods = True
    assert peer.receive(dropped.replace(b"{", b"["), 1.0) == []
