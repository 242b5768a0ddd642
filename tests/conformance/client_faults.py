"""Headsets with one fault each, and the check that is meant to find it: a right headset behind a proxy that errs."""

from __future__ import annotations

import json

from bridge.conformance import vectors
from macs_zenoh.protocol.wire import encode_message
from tests.conformance.faults import Faults
from tests.conformance.proxy import Link, changed, message_of, parts, said, with_management, with_message

EMPTY = bytes(8)


FAULTS = Faults()
frames, messages = FAULTS.frames, FAULTS.messages


def manager(frame: bytes) -> object:
    return said(frame).get("messageManager")


def is_configuration(frame: bytes) -> bool:
    return manager(frame) == "AgentclientConfigurer"


def is_registration(frame: bytes) -> bool:
    return manager(frame) == "RosAgentNodeRegistrationForwarder"


def is_node(frame: bytes, *kinds: int) -> bool:
    metadata = parts(message_of(frame))[0] or {}
    return frame[31:35] == bytes(4) and metadata.get("nodeType") in kinds


@frames("handshake.request_id")
def answers_under_another_number(frame: bytes, link: Link) -> list[bytes]:
    return [with_management(frame, requestId=1)] if is_configuration(frame) else [frame]


@frames("handshake.agent_type")
def says_it_is_a_robot(frame: bytes, link: Link) -> list[bytes]:
    return [with_management(frame, agentType=1)] if is_configuration(frame) else [frame]


@frames("handshake.group")
def has_a_group_in_words(frame: bytes, link: Link) -> list[bytes]:
    return [with_management(frame, groupId="three")] if is_configuration(frame) else [frame]


@frames("handshake.message")
def configures_with_a_message(frame: bytes, link: Link) -> list[bytes]:
    message = encode_message(b"{}", b"hello")
    return [with_message(frame, message)] if is_configuration(frame) else [frame]


@frames("handshake.once")
def answers_twice(frame: bytes, link: Link) -> list[bytes]:
    return [frame, frame] if is_configuration(frame) else [frame]


@frames("heartbeat.comes")
def has_no_heartbeat(frame: bytes, link: Link) -> list[bytes]:
    return [] if manager(frame) == "HeartbeatHandler" else [frame]


@frames("heartbeat.form")
def beats_with_metadata(frame: bytes, link: Link) -> list[bytes]:
    return [with_message(frame, encode_message(b"{}"))] if manager(frame) == "HeartbeatHandler" else [frame]


@frames("frames.sender_id")
def keeps_its_first_id(frame: bytes, link: Link) -> list[bytes]:
    return [with_message(frame, changed(message_of(frame), senderAgentId=7))] if is_registration(frame) else [frame]


@frames("frames.sizes")
def declares_too_much(frame: bytes, link: Link) -> list[bytes]:
    if not is_node(frame, 2):
        return [frame]
    return [frame[:39] + (1000).to_bytes(4, "little") + frame[43:]]


@frames("frames.metadata_keys")
def leaves_a_key_out(frame: bytes, link: Link) -> list[bytes]:
    metadata, data = parts(message_of(frame))
    if not is_node(frame, 2, 3):
        return [frame]
    del metadata["requestId"]
    return [with_message(frame, encode_message(json.dumps(metadata).encode(), data))]


@frames("frames.metadata_types")
def writes_numbers_as_text(frame: bytes, link: Link) -> list[bytes]:
    return [with_message(frame, changed(message_of(frame), requestId="0"))] if is_node(frame, 2, 3) else [frame]


@frames("frames.destinations")
def sends_to_nobody(frame: bytes, link: Link) -> list[bytes]:
    return [frame[:1] + bytes(30) + frame[31:]] if is_node(frame, 2, 3) else [frame]


@frames("nodes.data_type")
def writes_types_as_ros_2_does(frame: bytes, link: Link) -> list[bytes]:
    if not is_node(frame, 2):
        return [frame]
    return [with_message(frame, changed(message_of(frame), dataExchangeType="std_msgs/msg/String"))]


@frames("nodes.cdr")
def sends_ros_1_bytes(frame: bytes, link: Link) -> list[bytes]:
    metadata, data = parts(message_of(frame))
    if not is_node(frame, 2):
        return [frame]
    return [with_message(frame, encode_message(json.dumps(metadata).encode(), data[4:]))]


@frames("registering.name")
def names_nodes_as_it_likes(frame: bytes, link: Link) -> list[bytes]:
    if not is_registration(frame):
        return [frame]
    metadata, data = parts(message_of(frame))
    name = said(frame)["nodeName"].upper()
    message = encode_message(
        json.dumps(metadata).encode(), json.dumps({**json.loads(data), "nodeName": name}).encode()
    )
    return [with_message(with_management(frame, nodeName=name), message)]


@frames("registering.one_frame")
def registers_in_two_frames(frame: bytes, link: Link) -> list[bytes]:
    if not is_registration(frame):
        return [frame]
    return [with_message(frame, EMPTY), bytes(35) + len(message_of(frame)).to_bytes(4, "little") + message_of(frame)]


@frames("services.number")
def answers_calls_under_0(frame: bytes, link: Link) -> list[bytes]:
    return [with_message(frame, changed(message_of(frame), requestId=0))] if is_node(frame, 4) else [frame]


@messages("renumber.answers")
def ignores_a_later_id(message: bytes, link: Link) -> list[bytes]:
    metadata = parts(message)[0] or {}
    if metadata.get("messageManager") == "AgentConfigurer":
        if hasattr(link.notes, "greeted"):
            return []
        link.notes.greeted = True
    return [message]


def _deaf(message: bytes, link: Link, deafens: bool) -> list[bytes]:
    """As the existing headset: after such a message it handles none."""
    link.notes.deaf = deafens or (hasattr(link.notes, "deaf") and link.notes.deaf)
    return [] if link.notes.deaf else [message]


@messages("bad.metadata_empty")
def goes_deaf_without_metadata(message: bytes, link: Link) -> list[bytes]:
    return _deaf(message, link, message[:4] == bytes(4) and len(message) > 8)


@messages("bad.unknown_manager")
def goes_deaf_on_unknown_managers(message: bytes, link: Link) -> list[bytes]:
    metadata = parts(message)[0]
    known = not isinstance(metadata, dict) or metadata.get("messageManager") != "NoSuchManagerOfAnybody"
    return _deaf(message, link, not known)


@messages("bad.topic_cut")
def goes_deaf_on_cut_topics(message: bytes, link: Link) -> list[bytes]:
    metadata, data = parts(message)
    cut = isinstance(metadata, dict) and metadata.get("nodeType") == 1 and data == b"\x00\x01\x00\x00"
    return _deaf(message, link, cut)


@messages("messages.agents_gone")
def goes_deaf_when_robots_leave(message: bytes, link: Link) -> list[bytes]:
    return _deaf(message, link, b'"agent_type": 1' in message)


@frames("reconnect.registers")
def forgets_its_nodes(frame: bytes, link: Link) -> list[bytes]:
    first = link is link.proxy.links[0]
    return [] if is_registration(frame) and not first else [frame]


@frames("reconnect.after_end")
def never_comes_back(frame: bytes, link: Link) -> list[bytes]:
    if is_configuration(frame):
        link.proxy.stop_listening()
    return [frame]


def is_back(frame: bytes) -> bool:
    """A configuration that shows a session's secret."""
    return is_configuration(frame) and bool(said(frame).get("session"))


def came_back(frame: bytes, link: Link) -> bool:
    """Whether this connection began with one."""
    link.notes.back = is_back(frame) or getattr(link.notes, "back", False)
    return bool(link.notes.back)


@frames("sessions.asks")
def asks_with_a_secret_of_its_own(frame: bytes, link: Link) -> list[bytes]:
    return [with_management(frame, session="mine")] if is_configuration(frame) and not is_back(frame) else [frame]


@frames("sessions.shows")
def forgets_its_secret(frame: bytes, link: Link) -> list[bytes]:
    return [with_management(frame, session="")] if is_back(frame) else [frame]


@frames("sessions.received")
def counts_its_greeting(frame: bytes, link: Link) -> list[bytes]:
    return [with_management(frame, received=said(frame)["received"] + 1)] if is_back(frame) else [frame]


@frames("sessions.waits")
def speaks_before_it_is_told(frame: bytes, link: Link) -> list[bytes]:
    beat = vectors.fill("headset_frames", "heartbeat")
    return [frame, beat] if is_back(frame) else [frame]


@frames("sessions.id")
def takes_the_new_id(frame: bytes, link: Link) -> list[bytes]:
    if not came_back(frame, link) or is_configuration(frame) or not parts(message_of(frame))[0]:
        return [frame]
    return [with_message(frame, changed(message_of(frame), senderAgentId=41))]


@frames("sessions.says_again")
def says_nothing_again(frame: bytes, link: Link) -> list[bytes]:
    return [] if came_back(frame, link) and is_registration(frame) else [frame]


@messages("sessions.registers_nothing")
def believes_that_nothing_has_come(message: bytes, link: Link) -> list[bytes]:
    metadata, data = parts(message)
    if (metadata or {}).get("messageManager") != "SessionResumed":
        return [message]
    nothing = json.dumps({**json.loads(data), "received": 0}).encode()
    return [encode_message(json.dumps(metadata).encode(), nothing)]


@messages("sessions.forgotten")
def believes_that_it_is_known(message: bytes, link: Link) -> list[bytes]:
    metadata, _ = parts(message)
    if (metadata or {}).get("messageManager") != "SessionOpened":
        return [message]
    link.proxy.shared.opened = getattr(link.proxy.shared, "opened", 0) + 1
    if link.proxy.shared.opened == 1:
        return [message]
    return [vectors.fill("router_messages", "session_resumed", id=31, heard=1_000_000)]
