"""What may be said to one TCP agent: by what it registered, asked and was told, and in which words."""

from __future__ import annotations

import pytest

from macs_zenoh.errors import Refused
from macs_zenoh.protocol.existing import PASS
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AddNode,
    AgentsGone,
    GoneAgent,
    Metadata,
    NodeRefused,
    NodeType,
    RemoveNode,
    Welcome,
    decode_data,
    encode_data,
    node_name,
)
from macs_zenoh.protocol.recipient import Recipient, registration, to_agent
from macs_zenoh.protocol.wire import Header, split_message


def adding(topic: str = "/pose", kind: NodeType = NodeType.SUBSCRIBER, of: str = "geometry_msgs/Pose") -> AddNode:
    """A registration by headset 5."""
    return AddNode(UNITY, 5, kind, node_name(topic), topic, of, buffer_size=7)


def sent(topic: str = "/pose", kind: NodeType = NodeType.SUBSCRIBER, of: str = "geometry_msgs/Pose") -> Metadata:
    """A robot's message of a node."""
    return Metadata(ROS, 7, node_type=kind, node_name=node_name(topic), data_exchange_type=of)


def headset(*, there: bool = True, existing: bool = True) -> Recipient:
    """A headset that registered a topic, on the robot that sends it or not."""
    recipient = Recipient(lambda metadata: there)
    recipient.configured(UNITY, existing=existing)
    recipient.registered(adding())
    return recipient


# -- a headset -------------------------------------------------------------------------------------------------------


def test_an_existing_headset_gets_what_it_registered_where_it_did() -> None:
    """Topic data passes from a robot on which the headset has the node, and from no other."""
    assert headset().verdict(sent()).name == ""
    assert headset(there=False).verdict(sent()).name == "not_registered"
    assert headset(existing=False).verdict(sent()) is PASS


def test_what_is_taken_back_is_judged_anew() -> None:
    """After the end of a registration nothing of it is remembered: neither a verdict nor how much may wait."""
    recipient = headset(existing=False)
    assert (recipient.has(sent()), recipient.depth_of("nd__pose"), recipient.node_count) == (True, (7, False), 1)
    assert recipient.verdict(sent()) is PASS
    recipient.unregistered("nd__pose", NodeType.SUBSCRIBER)
    assert (recipient.has(sent()), recipient.depth_of("nd__pose"), recipient.node_count) == (False, (10, False), 0)


@pytest.mark.parametrize("kind", [kind for kind in NodeType if kind != NodeType.SUBSCRIBER])
def test_who_commands_or_serves_does_not_only_listen(kind: NodeType) -> None:
    """However much it listens to; until it has taken that back, also under a name that is a topic's as well."""
    recipient = headset()
    assert recipient.only_listens
    for topic in ("/pose", "/other"):
        recipient.registered(adding(topic, kind))
        assert not recipient.only_listens
        recipient.unregistered(node_name(topic), kind)
        assert recipient.only_listens


def test_of_two_nodes_under_one_name_an_existing_headset_has_the_last() -> None:
    """Another type under a name takes the first one's place, and the gateway knows which that was."""
    recipient = headset()
    publisher = adding(kind=NodeType.PUBLISHER)
    assert recipient.other_type(adding()) is None
    assert recipient.other_type(publisher) == NodeType.SUBSCRIBER
    recipient.registered(publisher)
    assert recipient.verdict(sent()).name == "wrong_node_type"


def test_a_topic_goes_as_it_is_to_who_takes_it() -> None:
    """To an existing headset only with the type that it registered and data that fits; to a newer one in any case."""
    existing, newer = headset(), headset(existing=False)
    assert existing.takes("nd__pose", "geometry_msgs/Pose")
    assert not existing.takes("nd__pose", "geometry_msgs/Pose", fits=False)
    assert not existing.takes("nd__pose", "geometry_msgs/Twist")
    assert newer.takes("nd__pose", "geometry_msgs/Twist", fits=False)


def test_a_question_makes_room_for_its_answer() -> None:
    """A service's answer does not go to a headset that has not asked for it; once it has, it does."""
    recipient = headset()
    recipient.registered(adding("/set", NodeType.CLIENT, "std_srvs/SetBool"))
    answer = sent("/set", NodeType.CLIENT, "std_srvs/SetBool").numbered(3)
    assert recipient.verdict(answer).name == "not_asked"
    recipient.asks(answer.sent_by(UNITY, 5), Header(ROS, (7,), (), 0, 8))
    assert (recipient.verdict(answer).name, recipient.verdict(answer).answers) == ("", True)


# -- a robot program -------------------------------------------------------------------------------------------------


def test_a_robot_program_is_told_once() -> None:
    """A registration that it knows is not told again, its end is, and who has left is off its nodes."""
    robot = Recipient()
    robot.configured(ROS, existing=True)
    assert robot.tell(adding(), None) == registration(adding())
    assert robot.tell(adding(), None) is None
    removing = RemoveNode(UNITY, 5, NodeType.SUBSCRIBER, node_name("/pose"))
    assert robot.tell(removing, None) == registration(removing)
    robot.tell(adding(), None)
    robot.gone([GoneAgent(UNITY, 5)])
    assert robot.robot_nodes.registrants() == []


def test_a_robot_program_gets_messages_of_its_nodes_only() -> None:
    """What it was told decides: a command before its registration does not reach it, and one after does."""
    robot = Recipient()
    robot.configured(ROS, existing=True)
    command = Metadata(UNITY, 5, node_type=2, node_name="nd__cmd", data_exchange_type="geometry_msgs/Twist")
    assert robot.verdict(command).name == "unknown_node"
    robot.tell(adding("/cmd", NodeType.PUBLISHER, "geometry_msgs/Twist"), None)
    assert robot.verdict(command).name == ""


def test_a_robot_program_is_not_told_what_it_would_not_survive() -> None:
    """A type that nobody has is refused with a reason, and nothing is said."""
    robot = Recipient()
    robot.configured(ROS, existing=True)
    with pytest.raises(Refused):
        robot.tell(adding(of="geometry_msgs/Nonsense"), None)
    assert robot.robot_nodes.registrants() == []


# -- a gateway's own words -------------------------------------------------------------------------------------------


def test_what_a_manager_says_names_it() -> None:
    """Existing programs know a gateway's message by its manager, and read the data by that."""
    for said in (Welcome(5), AgentsGone([GoneAgent(ROS, 7)]), NodeRefused(7, 1, "nd__a", "/a", "no")):
        metadata, data = split_message(to_agent(said))
        assert Metadata.decode(metadata) == Metadata(message_manager=said.manager)
        assert decode_data(type(said), bytes(data)) == said


def test_an_answer_has_the_number_of_its_question_and_no_manager() -> None:
    """Plain answers are told apart by their request id alone."""
    metadata, data = split_message(to_agent(b'{"a":1}', request_id=9))
    assert (Metadata.decode(metadata), bytes(data)) == (Metadata(request_id=9), b'{"a":1}')


def test_a_registration_is_in_the_name_of_who_registers() -> None:
    """A robot program answers to that sender."""
    metadata, data = split_message(registration(adding()))
    assert Metadata.decode(metadata) == Metadata(UNITY, 5, message_manager=AddNode.manager)
    assert bytes(data) == encode_data(adding())
