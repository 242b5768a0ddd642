"""What may go to existing programs, by metadata and data."""

from __future__ import annotations

from typing import Any

import pytest

from macs_zenoh.protocol.existing import (
    CDR,
    PASS,
    Asked,
    Data,
    OwnNode,
    Verdict,
    asks,
    fitting,
    readable,
    to_headset,
    to_newer,
    to_robot,
)
from macs_zenoh.protocol.messages import FOR_NEWER, MANAGERS, ROS, UNITY, AddNode, Metadata, NodeType
from macs_zenoh.protocol.offers import short_type
from macs_zenoh.protocol.wire import Header, encode_frame, encode_message, parse_frame, parse_runs, split_message

TEXT = CDR + b"\x02\x00\x00\x00a\x00"
FORBIDDEN = [
    "AgentConfigurer",
    "PrunedUnityAgentsInterfaceNodesCleaner",
    "InterfaceNodeRefused",
    "a.b",
    "Console, mscorlib",
    "System.Console",
    "List`1",
    "9lives",
    "Grüße",
    " ",
    "x" * 300,
]


def said(kind: int = ROS, **fields: Any) -> Metadata:
    """Metadata of a message by agent 1."""
    return Metadata(kind, 1, **fields)


def of_node(node_type: int, name: str = "nd__a", kind: int = ROS, **fields: Any) -> Metadata:
    """Metadata of a node's message."""
    return said(kind, node_type=node_type, node_name=name, data_exchange_type="std_msgs/String", **fields)


def heard(metadata: Metadata, nodes: dict[str, int] | None = None, *, there: bool = False, asked: Any = None) -> str:
    """What an existing headset makes of a message: the name of the counter, empty for one that it gets."""
    return to_headset(metadata, own(nodes or {}), asked or Asked(), registered_there=there).name


def own(nodes: dict[str, int], of_type: str = "std_msgs/String") -> dict[str, OwnNode]:
    """A headset's nodes."""
    return {name: OwnNode(kind, of_type) for name, kind in nodes.items()}


# -- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("manager", sorted(FOR_NEWER))
def test_extensions_go_to_those_who_know_them(manager: str) -> None:
    """What only newer programs have is for them, and for no existing headset."""
    assert heard(said(message_manager=manager)) == "forbidden_manager"
    assert to_newer(said(message_manager=manager), {}) is PASS


@pytest.mark.parametrize("manager", FORBIDDEN)
def test_names_that_no_agent_says_to_a_tcp_agent(manager: str) -> None:
    """What only a router says, and what is no plain identifier, reaches no TCP agent, newer or not."""
    assert heard(said(message_manager=manager)) == "forbidden_manager"
    assert to_newer(said(message_manager=manager), {}).name == "forbidden_manager"


@pytest.mark.parametrize("manager", sorted({*MANAGERS, "ManagementMessageManager", "managementmessagemanager"}))
def test_classes_of_the_existing_headset_are_not_named(manager: str) -> None:
    """A headset creates the class that a manager's name is, so no agent says one of the protocol's own."""
    assert heard(said(message_manager=manager)) == "forbidden_manager"


@pytest.mark.parametrize("manager", ["Greeting", "SomeManager", "_x9"])
def test_managers_of_others_go_to_headsets(manager: str) -> None:
    """A name that the headset has no class for is ignored by it, so programs may add their own."""
    assert heard(said(UNITY, message_manager=manager)) == ""


@pytest.mark.parametrize("manager", ["", "Greeting", *sorted(MANAGERS)])
def test_an_existing_robot_gets_no_manager_of_an_agent(manager: str) -> None:
    """Whatever is no message of a node ends its thread; registrations are written by its gateway."""
    assert to_robot(said(UNITY, message_manager=manager), None, Asked()).name == "not_survived"


# -- messages of nodes, to headsets ----------------------------------------------------------------------------------


@pytest.mark.parametrize("node_type", range(7))
@pytest.mark.parametrize("own", range(1, 6))
def test_a_node_of_another_type_is_never_named(node_type: int, own: int) -> None:
    """Under the name of one of its nodes a headset gets that node's type only, whoever sends it."""
    for kind in (ROS, UNITY):
        verdict = heard(of_node(node_type, kind=kind), {"nd__a": own}, there=True)
        assert (verdict == "wrong_node_type") is (node_type != own)


@pytest.mark.parametrize("node_type", [NodeType.SUBSCRIBER, NodeType.SERVICE])
def test_topics_and_requests_come_from_where_they_are_registered(node_type: int) -> None:
    """Topic data and requests of services reach a headset only from robots on which it registered the node."""
    registered = to_headset(of_node(node_type), own({"nd__a": node_type}), Asked(), registered_there=True)
    assert (registered.name, registered.data) == ("", Data.CDR)
    assert heard(of_node(node_type), {"nd__a": node_type}) == "not_registered"
    assert heard(of_node(node_type)) == "not_registered"
    assert heard(of_node(node_type, kind=UNITY), {"nd__a": node_type}, there=True) == "not_from_robot"


def test_answers_come_from_who_was_asked() -> None:
    """An answer passes once, from the robot that was asked, under the request's number and node."""
    asked = Asked()
    nodes = {"nd__a": 3}
    request = of_node(3, kind=UNITY, request_id=5)
    assert heard(of_node(3, request_id=5), nodes, asked=asked) == "not_asked"
    asked.note(request, Header(ROS, (1, 2), (), 0, 0))
    others = Metadata(ROS, 3, 5, "", 3, "nd__a", "std_msgs/String")
    for wrong in (of_node(3, request_id=6), of_node(3, "nd__b", request_id=5), others):
        assert heard(wrong, nodes, asked=asked) == "not_asked"
    assert heard(of_node(3, request_id=5), nodes, asked=asked) == ""
    asked.answered(of_node(3, request_id=5))
    assert heard(of_node(3, request_id=5), nodes, asked=asked) == "not_asked"
    assert heard(Metadata(ROS, 2, 5, "", 3, "nd__a", "std_msgs/String"), nodes, asked=asked) == ""


SPELLINGS = [("std_msgs/String", "std_msgs/String"), ("std_msgs/msg/String", "std_msgs/String")]
SPELLINGS += [(ros, unity) for unity, ros in SPELLINGS]
OTHERS = ["std_msgs/Bool", "std_msgs/msg/Bool", "my_msgs/String", "String", "std_msgs", "std_msgs/string", "/", ""]


@pytest.mark.parametrize("node_type", [NodeType.SUBSCRIBER, NodeType.SERVICE, NodeType.ACTION])
def test_data_is_of_the_type_that_was_registered(node_type: int) -> None:
    """What names another type than the headset's own node, or none, is not sent; both ways to write a type are one."""
    for said_type, own_type in SPELLINGS:
        message = Metadata(ROS, 1, 0, "", node_type, "nd__a", said_type)
        nodes = own({"nd__a": node_type}, short_type(own_type))
        assert to_headset(message, nodes, Asked(), registered_there=True).name == ""
    for other in OTHERS:
        message = Metadata(ROS, 1, 0, "", node_type, "nd__a", other)
        assert heard(message, {"nd__a": node_type}, there=True) == "other_type", other


def test_an_answer_is_of_the_type_that_was_asked_for() -> None:
    """Also where the headset never registered the service: its request says what it reads."""
    for said_type, asked_type in SPELLINGS:
        asked = Asked()
        asked.note(Metadata(UNITY, 9, 5, "", 3, "nd__a", asked_type), Header(ROS, (1,), (), 0, 0))
        assert heard(Metadata(ROS, 1, 5, "", 3, "nd__a", said_type), asked=asked) == ""
    for other in OTHERS:
        assert heard(Metadata(ROS, 1, 5, "", 3, "nd__a", other), asked=asked) == "other_type", other


def test_data_is_judged_by_its_type_however_that_is_written() -> None:
    """As ROS writes a type, the same is known of it."""
    raw = said().encode()
    for name in ("std_msgs/msg/String", "std_msgs/msg/Float64", "geometry_msgs/msg/Twist"):
        metadata = Metadata(ROS, 1, 0, "", 1, "nd__a", name)
        frame = parse_frame(encode_frame(2, (1,), message=encode_message(raw, CDR + b"\x07\x00\x00\x00ab")))
        assert fitting(frame, Data.CDR, metadata) == ([], 1)
    empty = Metadata(ROS, 1, 0, "", 1, "nd__a", "std_msgs/msg/Empty")
    nodes = own({"nd__a": 1}, "std_msgs/Empty")
    assert to_headset(empty, nodes, Asked(), registered_there=True).data is Data.EMPTY_TOO


def test_who_asked_a_group_may_be_answered_by_anybody_in_it() -> None:
    """A request to a group or to everybody may have any number of answers."""
    for header in (Header(ROS, (), (4,), 0, 0), Header(0, (), (), 0, 0)):
        asked = Asked()
        asked.note(of_node(3, kind=UNITY, request_id=5), header)
        for _ in range(2):
            assert heard(of_node(3, request_id=5), asked=asked) == ""
            asked.answered(of_node(3, request_id=5))


def test_a_failure_comes_only_to_who_asked_for_it() -> None:
    """In place of an answer there may be a reason, where the request named that manager; else the answer is CDR."""
    failure = of_node(3, request_id=5, message_manager="InterfaceCallFailure")
    for manager, data in (("", Data.CDR), ("InterfaceCallFailure", Data.FAILURE_TOO)):
        asked = Asked()
        asked.note(of_node(3, kind=UNITY, request_id=5, message_manager=manager), Header(ROS, (1,), (), 0, 0))
        assert to_headset(failure, {}, asked, registered_there=False).data is data


def test_what_is_asked_is_bounded() -> None:
    """The oldest requests are forgotten first, plain ones and those of nodes alike."""
    asked = Asked()
    for number in range(2 * Asked.LIMIT):
        asked.note(said(UNITY, request_id=number, message_manager="X"), Header(ROS, (1,), (), 0, 0))
    assert [asked.awaits(said(request_id=number)) for number in (0, Asked.LIMIT - 1)] == [None, None]
    assert asked.awaits(said(request_id=Asked.LIMIT)) is Data.JSON
    assert not asked.awaits_another(said(request_id=0))
    assert asked.awaits_another(said(request_id=Asked.LIMIT))


def test_a_plain_message_is_not_taken_for_an_answer() -> None:
    """Plain data of others passes, unless its number is that of a request to somebody else."""
    asked = Asked()
    assert heard(said(UNITY)) == heard(said(UNITY), asked=asked) == ""
    asked.note(said(UNITY, message_manager="RobotStatus"), Header(ROS, (1,), (), 0, 0))
    assert heard(Metadata(UNITY, 9), asked=asked) == heard(Metadata(ROS, 2), asked=asked) == "not_asked"
    answer = to_headset(said(), {}, asked, registered_there=False)
    assert answer == Verdict(data=Data.JSON, stays=False, answers=True)


def test_node_types_of_robots_only() -> None:
    """A message of a publisher or of no known type is for no headset; one of an action for who registered it."""
    for node_type in (0, 2, 5, 6, 255):
        assert heard(of_node(node_type)) == "unknown_node"
    assert heard(of_node(5), {"nd__a": 5}) == ""
    assert heard(of_node(1, kind=UNITY)) == ""  # for no node of it, and by no robot: ignored


# -- messages of nodes, to robots ------------------------------------------------------------------------------------


NODE = AddNode(UNITY, 1, 2, "nd__a", "/a", "std_msgs/String")


@pytest.mark.parametrize("node_type", range(7))
def test_a_robot_gets_messages_of_its_nodes(node_type: int) -> None:
    """Topics, requests and answers, of nodes that were registered; never topic data, actions or other types."""
    taken = node_type in (2, 3)
    assert (to_robot(of_node(node_type, kind=UNITY), NODE, Asked()).name == "") is taken
    assert to_robot(of_node(node_type, kind=UNITY), None, Asked()).name != ""


def test_a_robot_gets_the_type_of_its_node() -> None:
    """A message that names another type than its node's, or none, is not sent."""
    for name in ("", "std_msgs/Bool", "os/path"):
        metadata = Metadata(UNITY, 1, node_type=2, node_name="nd__a", data_exchange_type=name)
        assert to_robot(metadata, NODE, Asked()).name == "other_type"


def test_a_robot_gets_answers_of_who_serves() -> None:
    """The answer of a headset's service comes from the registrant, once, and to a question of the robot."""
    node = AddNode(UNITY, 1, 4, "nd__a", "/a", "std_msgs/String")
    asked = Asked()
    answer = of_node(4, kind=UNITY, request_id=9)
    assert to_robot(answer, node, asked).name == "not_asked"
    asked.note(of_node(4, request_id=9), Header(UNITY, (1,), (), 0, 0))
    assert to_robot(answer, node, asked) == Verdict(data=Data.CDR, stays=False, answers=True)
    assert to_robot(Metadata(UNITY, 2, 9, "", 4, "nd__a", "std_msgs/String"), node, asked).name == "not_registered"


# -- data ------------------------------------------------------------------------------------------------------------

SHAPES = {
    "nothing": b"",
    "one byte": b"\x00",
    "no fields, as Unity writes it": CDR,
    "big endian": b"\x00\x00\x00\x00abcd",
    "ROS 1": b"\x02\x00\x00\x00a",
    "JSON": b'{"kind":"timeout","reason":"x"}',
    "a list": b"[]",
    "half of JSON": b'{"a":',
    "text": b"hello",
    "CDR": TEXT,
    "no fields, as ROS writes it": CDR + b"\x00",
}
FITS = {
    Data.CDR: {"CDR", "no fields, as ROS writes it"},
    Data.EMPTY_TOO: {"CDR", "no fields, as ROS writes it", "no fields, as Unity writes it"},
    Data.JSON: {"JSON"},
    Data.FAILURE_TOO: {"CDR", "no fields, as ROS writes it", "JSON"},
}


@pytest.mark.parametrize("data", FITS, ids=str)
def test_which_data_fits(data: Data) -> None:
    """Each shape of data is judged by what it must be, alone and among others."""
    raw = said().encode()
    frames = {name: encode_frame(2, (1,), message=encode_message(raw, shape)) for name, shape in SHAPES.items()}
    for name, frame in frames.items():
        messages, others = fitting(parse_frame(frame), data, said())
        assert (len(messages), others) == ((1, 0) if name in FITS[data] else (0, 1)), name
        for message in messages:
            sent = bytes(split_message(message)[1])
            assert sent == (CDR + b"\x00" if SHAPES[name] == CDR else SHAPES[name])


def test_a_run_is_judged_message_by_message() -> None:
    """Of messages that begin alike those that fit are sent, in order."""
    raw = said().encode()
    bodies = [CDR + bytes([n]) if n % 3 else b"abcde" for n in range(9)]
    (frame,) = parse_runs(b"".join(encode_frame(2, (1,), message=encode_message(raw, body)) for body in bodies))
    messages, others = fitting(frame, Data.CDR, said())
    assert [bytes(split_message(message)[1]) for message in messages] == [body for body in bodies if body[:4] == CDR]
    assert others == 3


def test_what_is_cut_off_is_seen_where_the_length_is_known() -> None:
    """Of types that people drive with, data that is too short does not fit; answers of services have their own."""
    cases = [
        (2, "geometry_msgs/Twist", 52, True),
        (2, "geometry_msgs/Twist", 51, False),
        (1, "std_msgs/Bool", 5, True),
        (1, "std_msgs/Float64", 11, False),
        (3, "std_srvs/SetBool", 5, True),
        (4, "std_srvs/SetBool", 12, False),
        (4, "std_srvs/SetBool", 13, True),
        (2, "my_msgs/Any", 5, True),
    ]
    for node_type, name, size, fits in cases:
        metadata = Metadata(UNITY, 1, 0, "", node_type, "nd__a", name)
        frame = parse_frame(encode_frame(1, (1,), message=encode_message(metadata.encode(), CDR + bytes(size - 4))))
        assert len(fitting(frame, Data.CDR, metadata)[0]) == fits, (node_type, name, size)
    metadata = of_node(2)
    for text, fits in ((TEXT, True), (TEXT[:-1], False), (TEXT + b"\x00\x00", True), (CDR + b"\xff" * 8, False)):
        frame = parse_frame(encode_frame(1, (1,), message=encode_message(metadata.encode(), text)))
        assert len(fitting(frame, Data.CDR, metadata)[0]) == fits


# -- metadata --------------------------------------------------------------------------------------------------------


def test_metadata_of_existing_programs_is_readable() -> None:
    """Compact or not, in any order, with keys that mean nothing."""
    raw = of_node(1).encode()
    assert readable(raw)
    assert readable(raw.replace(b":", b": ").replace(b",", b", "))
    assert readable(raw[:-1] + b',"somethingNew":{"nodeName":[1]}}')


@pytest.mark.parametrize(
    "raw",
    [
        b"{}",
        b"[]",
        b"",
        Metadata().encode(),
        of_node(1).encode()[:-1] + b',"nodeName":""}',
        of_node(1).encode()[:-1] + b',"NODENAME":""}',
        of_node(1).encode()[:-1] + b',"node_name":""}',
        of_node(1).encode().replace(b'"nodeType":1', b'"nodeType":1.0'),
        of_node(1).encode().replace(b'"nodeType":1', b'"nodeType":true'),
        of_node(1).encode().replace(b'"nodeType":1,', b""),
        of_node(1).encode().replace(b'"nodeName":"nd__a"', b'"nodeName":null'),
        b'{"a":' + b"[" * 100_000,
    ],
)
def test_metadata_that_others_may_read_differently(raw: bytes) -> None:
    """Keys that are missing, there twice, spelled otherwise or of another type are written anew."""
    assert not readable(raw)


def test_what_asks() -> None:
    """Calls of services, and messages of managers, may be answered; topic data and plain data are no questions."""
    assert all(map(asks, (of_node(3), of_node(4), said(message_manager="X"))))
    assert not any(map(asks, (of_node(1, message_manager="RosAgentSubscriberDataForwarder"), of_node(2), said())))


def test_a_newer_agent_gets_the_rest() -> None:
    """An agent that says it is newer is kept from little: names of routers, and nodes of another type."""
    assert to_newer(said(message_manager="FunctionalityGetter"), {}) is PASS
    assert to_newer(of_node(2), {}) is to_newer(of_node(2), {"nd__a": {1, 2}}) is PASS
    assert to_newer(of_node(3), {"nd__a": {1, 2}}).name == "wrong_node_type"
