"""What a token permits: each right by one attempt that it allows and one that it does not, by id, group and name."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from macs_zenoh.protocol.messages import (
    EVERYBODY,
    MANAGERS,
    ROS,
    UNITY,
    AddNode,
    Metadata,
    NodeType,
    RemoveNode,
    node_name,
)
from macs_zenoh.protocol.rights import RIGHTS, Right, Rights
from macs_zenoh.protocol.wire import Header

OF_NODES: dict[int, Right] = {1: "see", 2: "command", 3: "call", 4: "serve", 5: "act"}


def rights(*may: Right, **said: Any) -> Rights:
    """These rights at robots 1 and 2 and in group 3."""
    return Rights(may=list(may), **{"robots": [1, 2], "groups": [3], **said})


def node(node_type: int, name: str = "/camera/image") -> AddNode:
    """A registration of this name."""
    return AddNode(UNITY, 300, node_type, node_name(name), name, "pkg/Type")


def header(agent_type: int = ROS, ids: tuple[int, ...] = (), groups: tuple[int, ...] = ()) -> Header:
    """Where a frame goes."""
    return Header(agent_type, ids, groups, 0, 0)


def data(node_type: int, name: str = "/camera/image") -> Metadata:
    """Of a frame with data for this node."""
    return Metadata(UNITY, 300, 0, "", node_type, node_name(name), "pkg/Type")


@pytest.mark.parametrize(("node_type", "right"), OF_NODES.items())
def test_each_kind_of_node_needs_its_right(node_type: int, right: Right) -> None:
    """With the right a node can be registered and data sent to it; with all other rights neither can."""
    others = [each for each in RIGHTS if each not in (right, "broadcast", "record", "robot")]
    granted, withheld = rights(right), rights(*others)
    assert granted.of_registration(node(node_type), [1], [3]) is None
    assert f"right to {right}" in (withheld.of_registration(node(node_type), [1], [3]) or "")
    for each, why in ((granted, None), (withheld, f"this token does not give the right to {right}")):
        assert each.of_frame(header(ids=(1,)), data(node_type), "/camera/image") == why


@pytest.mark.parametrize("node_type", [0, 6, 255])
def test_other_kinds_of_nodes_need_what_nobody_has(node_type: int) -> None:
    """There is no right to what this version does not know."""
    everything = Rights(may=list(RIGHTS), robots="any", groups="any")
    assert "no nodes of type" in (everything.of_registration(node(node_type), [1], []) or "")


def test_robots_and_groups_that_are_not_named_are_out_of_reach() -> None:
    """A token for robots 1 and 2 and group 3 reaches no other by id or group, however they are mixed."""
    mine = rights("see", "command", "ask")
    for ids, groups, allowed in [
        ((1,), (), True),
        ((1, 2), (3,), True),
        ((), (3,), True),
        ((7,), (), False),
        ((1, 7), (), False),
        ((), (4,), False),
        ((1,), (3, 4), False),
    ]:
        where = header(ids=ids, groups=groups)
        assert (mine.of_registration(node(1), ids, groups) is None) is allowed
        leaving = RemoveNode(UNITY, 300, 1, "nd__x")
        assert (mine.of_registration(leaving, ids, groups) is None) is allowed
        assert (mine.of_frame(where, data(2), "/camera/image") is None) is allowed
        assert (mine.of_frame(where, Metadata(), None) is None) is allowed


def test_topics_are_judged_by_their_full_names() -> None:
    """Patterns hold, and no other spelling gets around them: relative, private, hidden, or with something put in."""
    mine = rights("see", "command", "call", topics=["/camera/**", "/pose"])
    for name, allowed in [
        ("/camera/image", True),
        ("/camera/a/b", True),
        ("/pose", True),
        ("/cmd_vel", False),
        ("/cameras", False),
        ("camera/image", False),
        ("~/camera", False),
        ("/camera/../cmd_vel", False),
        ("/camera/{node}", False),
        ("/camera//x", False),
        ("/camera/_hidden", False),
        ("/camera/image\n", False),
        ("", False),
    ]:
        for node_type in (1, 2, 3):
            assert (mine.of_registration(node(node_type, name), [1], []) is None) is allowed, name
    everywhere = rights("command")
    assert everywhere.of_registration(node(2, "cmd_vel"), [1], []) is None
    assert everywhere.of_registration(node(2, "/{ns}emergency_stop"), [1], []) is not None


def test_data_needs_a_registration_under_its_name() -> None:
    """Two topics share a node name, so what counts is what was registered, not what the name may mean."""
    mine = rights("command", topics=["/a_b"])
    assert node_name("/a_b") == node_name("/a/b")
    assert mine.of_frame(header(ids=(1,)), data(2, "/a/b"), None) is not None
    assert mine.of_frame(header(ids=(1,)), data(2, "/a_b"), "/a_b") is None
    assert mine.of_registration(node(2, "/a/b"), [1], []) is not None


@pytest.mark.parametrize("name", ["/emergency_stop", "emergency_stop", "/emergency/stop"])
def test_a_stop_needs_its_right_and_no_other(name: str) -> None:
    """To stop is not to command: each without the other, whatever topics are named."""
    stop, command = rights("stop", topics=["/pose"]), rights("command", "see", "call", "serve", "act", "ask")
    assert stop.of_registration(node(2, name), [1], []) is None
    assert stop.of_frame(header(ids=(1,)), data(2, name), name) is None
    assert "right to stop" in (command.of_registration(node(2, name), [1], []) or "")
    assert "right to stop" in (command.of_frame(header(ids=(1,)), data(2, name), name) or "")
    assert stop.of_registration(node(2, "/pose"), [1], []) is not None
    assert stop.of_registration(node(1, name), [1], []) is not None  # to hear of it is to see
    assert rights("stop", stop_topics=["/halt"]).of_registration(node(2, "/halt"), [1], []) is None


@pytest.mark.parametrize(
    ("manager", "right"),
    [
        ("RobotStatus", "see"),
        ("FunctionalityGetter", "see"),
        ("RobotControl", "command"),
        ("CommandClock", "command"),
        ("Own", "ask"),
        ("", "ask"),
    ],
)
def test_requests_to_robots_need_what_they_do(manager: str, right: Right) -> None:
    """To ask how a robot is, is to see; to take control, to command; for all else there is a right to ask."""
    asked = Metadata(message_manager=manager)
    others = [each for each in RIGHTS if each not in (right, "broadcast", "record", "robot")]
    assert rights(right).of_frame(header(ids=(1,)), asked, None) is None
    assert rights(*others).of_frame(header(ids=(1,)), asked, None) is not None


def test_what_routers_say_nobody_may_send() -> None:
    """Messages of the protocol go to no robot as plain messages."""
    everything = rights(*(each for each in RIGHTS if each not in ("broadcast", "record")))
    for manager in set(MANAGERS) - {"FunctionalityGetter"}:
        assert everything.of_frame(header(ids=(1,)), Metadata(message_manager=manager), None) is not None


def test_headsets_and_everybody_need_rights_of_their_own() -> None:
    """Sending to headsets and to everybody is not part of what one may do with robots, nor is one of the other."""
    robots_only = rights("see", "command", "call", "serve", "act", "stop", "ask")
    assert robots_only.of_frame(header(UNITY, (300,)), Metadata(), None) is not None
    assert robots_only.of_frame(header(EVERYBODY), Metadata(), None) is not None
    assert rights("send").of_frame(header(UNITY, (300,), (3,)), Metadata(), None) is None
    assert rights("send").of_frame(header(UNITY, (), (4,)), Metadata(), None) is not None
    assert rights("send", robots="any").of_frame(header(EVERYBODY), Metadata(), None) is not None
    loud = rights("broadcast", robots="any")
    assert loud.of_frame(header(EVERYBODY), Metadata(), None) is None
    assert loud.of_frame(header(EVERYBODY), data(2, "/cmd_vel"), "/cmd_vel") is not None
    for manager, needed in {"RobotStatus": "see", "RobotControl": "command", "Own": "ask"}.items():
        asking = Metadata(UNITY, 300, message_manager=manager)
        assert loud.of_frame(header(EVERYBODY), asking, None) is not None
        assert rights("broadcast", needed, robots="any").of_frame(header(EVERYBODY), asking, None) is None
    assert loud.of_frame(header(UNITY, (300,)), Metadata(), None) is not None
    assert loud.of_frame(header(7, (300,)), Metadata(), None) is not None
    with pytest.raises(ValueError, match="needs --robots any"):
        rights("broadcast")


def test_groups_to_be_in() -> None:
    """An agent may be in no group and in those of its token."""
    assert [group for group in range(256) if rights("see").may_be_in(group)] == [0, 3]
    assert Rights(groups="any").may_be_in(200)


def test_nothing_is_permitted_by_default() -> None:
    """Rights that say nothing permit nothing, and a misspelled one is an error."""
    nothing = Rights()
    assert all(nothing.of_registration(node(kind), [1], []) for kind in NodeType)
    assert nothing.of_frame(header(ids=(1,)), Metadata(), None) is not None
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"may": ["seee"]}, Rights)
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"mya": []}, Rights)


def test_to_record_is_for_who_may_see_everything() -> None:
    """A recording has every robot and topic: no token for a part of them gives the right."""
    assert rights("record", robots="any").has("record")
    with pytest.raises(ValueError, match="every robot"):
        rights("record")
    with pytest.raises(ValueError, match="every robot"):
        rights("record", robots="any", topics=["/camera/**"])
