"""Metadata and management data: every spelling is read, nothing of the wrong type is, and no bytes do harm."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.errors import BadField, BadJson, UnknownManager, WireError
from macs_zenoh.protocol import messages
from macs_zenoh.protocol.messages import (
    MANAGERS,
    AddNode,
    AgentsGone,
    Configuration,
    Custom,
    Functionality,
    GoneAgent,
    Heartbeat,
    Management,
    Metadata,
    NodeType,
    OnlineReply,
    RemoveNode,
    StreamData,
    Welcome,
    correct_sender,
    decode_data,
    decode_management,
    encode_data,
    encode_management,
    node_name,
)
from tests.support.recordings import reading

ADD_NODE = {
    "registrantAgentType": 2,
    "registrantAgentId": 7,
    "nodeType": 1,
    "nodeName": "nd__chatter",
    "tosName": "/chatter",
    "dataExchangeType": "std_msgs/String",
}
NAMES_OF_FIELDS = {
    "AgentConfigurer": {"agentId"},
    "AgentclientConfigurer": {"agentType", "agentId", "groupId", "requestId", "functionality"},
    "HeartbeatHandler": set(),
    "OnlineAgentsGetter": {"agentType", "agentId"},
    "RosAgentNodeRegistrationForwarder": {
        "registrantAgentId",
        "registrarAgentIds",
        "registrarGroupIds",
        "nodeType",
        "nodeName",
        "tosName",
        "dataExchangeType",
    },
    "InterfaceNodeAdder": {*ADD_NODE, "bufferSize", "dropNew", "isLatched"},
    "InterfaceNodeRemover": {"registrantAgentType", "registrantAgentId", "nodeType", "nodeName"},
    "RosAgentSubscriberDataForwarder": {"destAgents"},
    "UnityAgentclientRemover": {"agentId"},
    "PrunedUnityAgentsInterfaceNodesCleaner": {"agents"},
    "FunctionalityGetter": set(),
}
"""Section 4 of the protocol page."""


OURS = {
    "InterfaceNodeRefused": {"robotId", "nodeType", "nodeName", "tosName", "reason"},
    "AccessRefused": {"kind", "reason", "requestId"},
    "SessionOpened": {"session", "resumeS"},
    "SessionResumed": {"agentId", "received", "gap"},
}
"""What existing programs do not have."""

OUR_KEYS = {
    "AgentclientConfigurer": {"extensions", "token", "session", "received"},
    "HeartbeatHandler": {"received"},
    "InterfaceNodeAdder": {"unityCdr"},
}
"""Keys that existing programs do not write, and existing routers ignore."""

DEEP = 2000
"""More levels than many a reader follows."""


def values(annotation: Any) -> st.SearchStrategy[Any]:
    """Any value that a field with this annotation may have."""
    if get_origin(annotation) is Annotated:
        kind, meta = annotation.__origin__, annotation.__metadata__[0]
        if kind is str:
            return st.text(min_size=meta.min_length or 0, max_size=20).filter(re.compile(meta.pattern).search)
        if kind is not int:
            return values(kind)
        return st.integers(meta.ge, meta.le if meta.le is not None else 1 << 70)
    if get_origin(annotation) is list:
        return st.lists(values(get_args(annotation)[0]), max_size=5)
    if get_origin(annotation) is dict:
        return st.dictionaries(*map(values, get_args(annotation)), max_size=4)
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return structs(annotation)
    if msgspec.UnsetType in get_args(annotation):
        return st.just(msgspec.UNSET) | values(get_args(annotation)[0])
    if type(None) in get_args(annotation):
        return st.none() | st.one_of(*[values(kind) for kind in get_args(annotation) if kind is not type(None)])
    return {str: st.text(max_size=20), bool: st.booleans(), float: st.floats(0, 1e6)}[annotation]


def structs(kind: type[msgspec.Struct]) -> st.SearchStrategy[Any]:
    """Any value of a kind of struct."""
    hints = get_type_hints(kind, include_extras=True)
    return st.builds(kind, **{name: values(hints[name]) for name in kind.__struct_fields__})


any_management = st.one_of([structs(kind) for kind in MANAGERS.values()])

any_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


def spellings(key: str) -> tuple[str, str, str]:
    """A camelCase key in camelCase, UpperCamelCase and snake_case."""
    snake = "".join("_" + letter.lower() if letter.isupper() else letter for letter in key)
    return key, key[0].upper() + key[1:], snake


def respelled(fields: dict[str, Any], spelling: int) -> bytes:
    """JSON with its top-level keys in one of the spellings."""
    return json.dumps({spellings(key)[spelling]: value for key, value in fields.items()}).encode()


# -- the table -------------------------------------------------------------------------------------------------------


def test_every_manager_of_the_protocol_is_known_with_its_keys() -> None:
    """The managers and their keys are those of the protocol page and those of our own, no more and no less."""
    known = {name: set(kind.__struct_encode_fields__) - OUR_KEYS.get(name, set()) for name, kind in MANAGERS.items()}
    assert known == NAMES_OF_FIELDS | OURS


def test_node_types_have_the_numbers_of_the_wire() -> None:
    """Numbers 1 to 4 are subscriber, publisher, client and service, seen from the robot."""
    assert [NodeType(number).name for number in range(1, 5)] == ["SUBSCRIBER", "PUBLISHER", "CLIENT", "SERVICE"]


@pytest.mark.parametrize(
    ("tos_name", "name"),
    [("/cmd_vel", "nd__cmd_vel"), ("~/pose", "nd___pose"), ("camera/image", "nd_camera_image"), ("", "nd_")],
)
def test_node_names_are_those_of_the_existing_programs(tos_name: str, name: str) -> None:
    """A node is named for its topic with / and ~ replaced, as recorded from headsets."""
    assert node_name(tos_name) == name


# -- there and back --------------------------------------------------------------------------------------------------


@given(any_management)
def test_management_data_comes_back(value: Management) -> None:
    """Every value of every kind is the same after encoding and decoding, and names its manager."""
    encoded = encode_management(value)
    assert decode_management(encoded) == value
    assert json.loads(encoded)["messageManager"] == value.manager


@given(any_management | structs(OnlineReply) | structs(Functionality))
def test_json_in_the_data_comes_back(value: msgspec.Struct) -> None:
    """Every value of every kind is the same after encoding and decoding as a message's data."""
    assert decode_data(type(value), encode_data(value)) == value


@given(structs(Metadata))
def test_metadata_comes_back(value: Metadata) -> None:
    """Every metadata is the same after encoding and decoding, with all seven keys on the wire, and a clock if it has
    one."""
    assert Metadata.decode(value.encode()) == value
    assert list(json.loads(value.encode()))[:7] == [
        "senderAgentType",
        "senderAgentId",
        "requestId",
        "messageManager",
        "nodeType",
        "nodeName",
        "dataExchangeType",
    ]


def test_what_we_write_is_compact_camel_case() -> None:
    """Management data is written as headsets write it; the inner keys of who is gone are snake_case."""
    assert encode_management(Configuration(2, 7, 3, 42)) == (
        b'{"agentType":2,"agentId":7,"groupId":3,"requestId":42,"messageManager":"AgentclientConfigurer"}'
    )
    assert encode_management(Configuration(2, 7, extensions=1)).count(b'"extensions":1') == 1
    assert encode_data(Welcome(7)) == b'{"agentId":7}'
    assert encode_data(AgentsGone([GoneAgent(2, 7)])) == b'{"agents":[{"agent_type":2,"agent_id":7}]}'


def test_a_router_leaves_the_sender_null() -> None:
    """Metadata without a sender says null, as existing agents expect it from a router; request id 0 is written."""
    assert Metadata().encode().startswith(b'{"senderAgentType":null,"senderAgentId":null,"requestId":0,')


# -- spellings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spelling", [0, 1, 2], ids=["camel", "UpperCamel", "snake"])
@given(value=any_management)
def test_management_data_may_be_spelled_in_three_ways(spelling: int, value: Management) -> None:
    """Top-level keys in camelCase, UpperCamelCase and snake_case mean the same; unknown keys mean nothing."""
    fields = json.loads(encode_management(value))
    assert decode_management(respelled({**fields, "somethingNew": {"a": [1]}}, spelling)) == value


@pytest.mark.parametrize("spelling", [0, 1, 2], ids=["camel", "UpperCamel", "snake"])
def test_json_in_the_data_may_be_spelled_in_three_ways(spelling: int) -> None:
    """The keys of a node that a headset adds may be spelled like those of management data."""
    assert decode_data(AddNode, respelled(ADD_NODE, spelling)) == AddNode(
        2, 7, 1, "nd__chatter", "/chatter", "std_msgs/String"
    )


@pytest.mark.parametrize(
    "spelling",
    [
        0,
        1,
        2,
    ],
    ids=["camel", "UpperCamel", "snake"],
)
def test_metadata_may_be_spelled_in_three_ways(spelling: int) -> None:
    """Metadata in camelCase, UpperCamelCase and snake_case means the same."""
    fields = {"senderAgentType": 2, "senderAgentId": 7, "requestId": 5, "nodeName": "nd_x", "nodeType": 3}
    expected = Metadata(2, 7, 5, node_type=3, node_name="nd_x")
    assert Metadata.decode(respelled(fields, spelling)) == expected


def test_what_a_robot_offers_may_be_spelled_upper() -> None:
    """The keys inside functionality are read in any spelling; the names of topics in it stay as they are."""
    raw = b'{"agent_type":1,"agent_id":1,"functionality":{"Subscribers":{"/A_b":"T"}},"message_manager":"%s"}'
    value = decode_management(raw % Configuration.manager.encode())
    assert isinstance(value, Configuration)
    assert value.functionality == Functionality(subscribers={"/A_b": "T"})


def test_missing_keys_of_metadata_have_defaults() -> None:
    """Metadata may leave out every key, in any order and spacing, with unknown ones added."""
    assert Metadata.decode(b"{}") == Metadata()
    assert Metadata.decode(b' {"new": [{"a": null}], "nodeName" : "n", "requestId":0}\n') == Metadata(node_name="n")


# -- what is not accepted --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("raw", "error"),
    [
        (b"", BadJson),
        (b" ", BadJson),
        (b"{", BadJson),
        (b"[]", BadJson),
        (b"null", BadJson),
        (b"1", BadJson),
        (b'"HeartbeatHandler"', BadJson),
        (b'{"messageManager":NaN}', BadJson),
        (b'{"messageManager":"HeartbeatHandler"}}', BadJson),
        (b'\xef\xbb\xbf{"messageManager":"HeartbeatHandler"}', BadJson),
        (b'{"messageManager":"HeartbeatHandler","x":"\xff"}', BadJson),
        (b'{"messageManager":"HeartbeatHandler","x":' + b"[" * DEEP + b"]" * DEEP + b"}", BadJson),
        (b'{"messageManager":"HeartbeatHandler","x":' + b"1" * 5000 + b"}", BadJson),
        (b"{}", BadField),
        (b'{"agentId":7}', BadField),
        (b'{"messageManager":null}', BadField),
        (b'{"messageManager":7}', BadField),
        (b'{"messageManager":["HeartbeatHandler"]}', BadField),
        (b'{"messageManager":""}', UnknownManager),
        (b'{"messageManager":"heartbeatHandler"}', UnknownManager),
        (b'{"messageManager":"os.system"}', UnknownManager),
        (b'{"messageManager":"Management"}', UnknownManager),
    ],
)
def test_management_data_that_cannot_be_used(raw: bytes, error: type[WireError]) -> None:
    """Bytes that are no JSON object, name no manager or an unknown one raise the error that says so."""
    with pytest.raises(error):
        decode_management(raw)


@pytest.mark.parametrize(
    "fields",
    [
        {"agentId": 7},
        {"agentType": 2},
        {"agentType": "2", "agentId": 7},
        {"agentType": 2, "agentId": "7"},
        {"agentType": 2, "agentId": 7.5},
        {"agentType": 2, "agentId": None},
        {"agentType": 2, "agentId": True},
        {"agentType": 256, "agentId": 7},
        {"agentType": -1, "agentId": 7},
        {"agentType": 2, "agentId": 65536},
        {"agentType": 2, "agentId": 7, "groupId": 256},
        {"agentType": 2, "agentId": 7, "requestId": -1},
        {"agentType": 2, "agentId": 7, "requestId": 1 << 32},
        {"agentType": 2, "agentId": 7, "functionality": []},
        {"agentType": 2, "agentId": 7, "functionality": {"subscribers": {"/a": 1}}},
    ],
)
def test_fields_of_the_wrong_type_or_range_are_refused(fields: dict[str, Any]) -> None:
    """A key that is missing, or has a value of another type or out of range, raises BadField with the manager."""
    with pytest.raises(BadField) as raised:
        decode_management(json.dumps({**fields, "messageManager": Configuration.manager}).encode())
    assert raised.value.what == Configuration.manager


@pytest.mark.parametrize(
    "raw",
    [
        b'{"requestId":"1"}',
        b'{"requestId":-1}',
        b'{"senderAgentId":65536}',
        b'{"senderAgentType":256}',
        b'{"nodeName":null}',
        b'{"messageManager":1}',
        b'{"nodeType":"1"}',
        pytest.param(
            b'{"request_id":"1"}',
        ),
    ],
)
def test_metadata_of_the_wrong_type_or_range_is_refused(raw: bytes) -> None:
    """Metadata with a value of another type, or out of range, raises BadField."""
    with pytest.raises(BadField):
        Metadata.decode(raw)


@pytest.mark.parametrize("raw", [b"", b"[]", b"null", b"{", b"{}x", b'{"nodeName":"\xff"}', b'{"nodeName":"\\ud800"}'])
def test_metadata_that_is_no_json_object_is_refused(raw: bytes) -> None:
    """Metadata that is no JSON object raises BadJson."""
    with pytest.raises(BadJson):
        Metadata.decode(raw)


def test_metadata_nested_too_deep_is_refused() -> None:
    """Metadata with an unknown key that nests deeper than the interpreter can follow raises BadJson."""
    with pytest.raises(BadJson):
        Metadata.decode(b'{"x":' + b"[" * DEEP + b"]" * DEEP + b"}")


@pytest.mark.parametrize("raw", [b'{"new":"\xff"}', b'{"\xff":1}', b'{"new":["\xc3"]}'])
def test_metadata_that_is_not_utf8_is_refused(raw: bytes) -> None:
    """Metadata with a byte that is no UTF-8 anywhere raises BadJson: existing robots go deaf when it reaches them."""
    with pytest.raises(BadJson):
        Metadata.decode(raw)


@given(st.dictionaries(st.sampled_from(sorted(set().union(*NAMES_OF_FIELDS.values()))), any_json), st.data())
def test_any_json_is_management_data_or_an_error(fields: dict[str, Any], data: st.DataObject) -> None:
    """Whatever the fields are, management data decodes to the kind it names or raises a WireError."""
    manager = data.draw(st.sampled_from(sorted(MANAGERS)))
    with suppress(WireError):
        raw = respelled({**fields, "messageManager": manager}, data.draw(st.integers(0, 2)))
        assert type(decode_management(raw)) is MANAGERS[manager]


@given(st.binary(max_size=100) | any_json.map(lambda value: json.dumps(value).encode()))
def test_any_bytes_are_values_or_an_error(raw: bytes) -> None:
    """Any bytes, and any JSON, give values or a WireError wherever JSON is read."""
    for decode in (decode_management, Metadata.decode, lambda data: decode_data(AddNode, data)):
        with suppress(WireError):
            assert isinstance(decode(raw), msgspec.Struct)
    with suppress(WireError):
        assert isinstance(correct_sender(raw, 2, 7), bytes)


# -- managers of others ----------------------------------------------------------------------------------------------


class Battery(msgspec.Struct, rename="camel"):
    """Data of a manager that somebody added."""

    percent: Annotated[int, msgspec.Meta(ge=0, le=100)]
    robot_id: int = 0


def test_an_added_manager_is_read_like_ours() -> None:
    """Management data of a manager that was added decodes to its data in any spelling, and is as strict as ours."""
    custom = {"BatteryReporter": Battery}
    for raw in (
        b'{"messageManager":"BatteryReporter","percent":5,"robotId":7}',
        b'{"message_manager":"BatteryReporter","percent":5,"RobotId":7}',
    ):
        assert decode_management(raw, custom) == Custom("BatteryReporter", Battery(5, 7))
        with pytest.raises(UnknownManager):
            decode_management(raw)
    with pytest.raises(BadField):
        decode_management(b'{"messageManager":"BatteryReporter","percent":101}', custom)


def test_an_added_manager_replaces_none_of_ours() -> None:
    """A manager that was added under one of our names is never asked."""
    raw = b'{"messageManager":"HeartbeatHandler","percent":5}'
    assert decode_management(raw, {"HeartbeatHandler": Battery}) == Heartbeat()


# -- the true sender -------------------------------------------------------------------------------------------------


@given(
    st.dictionaries(
        st.sampled_from(["senderAgentId", "SenderAgentId", "sender_agent_id", "senderAgentType", "nodeName", "new"]),
        any_json,
    )
)
def test_a_corrected_sender_is_the_only_one(fields: dict[str, Any]) -> None:
    """Metadata with its sender corrected names that sender once, in whatever ways it named others before, and keeps
    everything else."""
    corrected = correct_sender(json.dumps(fields).encode(), 1, 300)
    assert reading(corrected) == {
        **reading(json.dumps(fields).encode()),
        "sender_agent_type": 1,
        "sender_agent_id": 300,
    }
    assert len(json.loads(corrected)) == len(reading(corrected))


def test_correcting_a_sender_leaves_unknown_keys_alone() -> None:
    """What a newer program adds to its metadata goes on as it was written."""
    corrected = correct_sender(b'{"senderAgentId":0,"somethingNew":1,"Other":2}', 2, 7)
    assert json.loads(corrected) == {"senderAgentType": 2, "senderAgentId": 7, "somethingNew": 1, "Other": 2}


def test_every_agent_of_a_stream_is_read() -> None:
    """Topic data may list any number of registrants, far more than a header has slots."""
    ids = list(range(1, 1001))
    raw = json.dumps({"destAgents": {"2": ids}, "messageManager": StreamData.manager}).encode()
    assert decode_management(raw) == StreamData({"2": ids})


def test_kinds_with_the_same_fields_stay_apart() -> None:
    """A remover and an adder are told apart by the manager, not by their fields."""
    raw = json.dumps({**ADD_NODE, "messageManager": RemoveNode.manager}).encode()
    assert decode_management(raw) == RemoveNode(2, 7, 1, "nd__chatter")
    assert messages.MANAGERS[RemoveNode.manager] is RemoveNode


@pytest.mark.parametrize("name", ["", "x" * 256, "a\nb", "\x1b[2J", "a\x7f", "a\x9b", "\u202eabc", "a\n", "\0"])
@pytest.mark.parametrize("kind", [AddNode, RemoveNode])
def test_names_of_nodes_are_plain(kind: Any, name: str) -> None:
    """No empty name, none longer than ROS has, no control characters, wherever a node is named."""
    fields = dict.fromkeys(("registrantAgentType", "registrantAgentId", "nodeType"), 1)
    fields |= {"tosName": "/t", "dataExchangeType": "std_msgs/String"}  # type: ignore[dict-item]
    with pytest.raises(BadField):
        decode_data(kind, json.dumps(fields | {"nodeName": name}).encode())
    if name:
        with pytest.raises(BadField):
            Metadata.decode(json.dumps({"nodeName": name}).encode())
    assert decode_data(kind, json.dumps(fields | {"nodeName": "nd_" + "x" * 252}).encode())
