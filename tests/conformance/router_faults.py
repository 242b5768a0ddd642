"""Routers with one fault each, and the check that is meant to find it: our gateway behind a proxy that errs."""

from __future__ import annotations

import json

from macs_zenoh.protocol.wire import encode_message
from tests.conformance.faults import Faults
from tests.conformance.proxy import Link, changed, message_of, parts, said, with_management

FAULTS = Faults()
frames, messages = FAULTS.frames, FAULTS.messages


def named(message: bytes) -> str:
    metadata = parts(message)[0]
    return str(metadata.get("messageManager", "")) if isinstance(metadata, dict) else ""


def is_online_answer(message: bytes) -> bool:
    return b"unityAgentIds" in parts(message)[1]


def is_from_agent(message: bytes) -> bool:
    metadata = parts(message)[0]
    return isinstance(metadata, dict) and metadata.get("senderAgentType") == 2


@messages("handshake.sender_null")
def greets_as_agent_0(message: bytes, link: Link) -> list[bytes]:
    return [changed(message, senderAgentType=0, senderAgentId=0)] if named(message) == "AgentConfigurer" else [message]


@messages("handshake.first")
def says_something_before(message: bytes, link: Link) -> list[bytes]:
    hello = encode_message(json.dumps({"messageManager": "Hello"}).encode(), b"{}")
    return [hello, message] if named(message) == "AgentConfigurer" else [message]


@messages("online.number_zero")
def takes_0_for_no_number(message: bytes, link: Link) -> list[bytes]:
    zero = is_online_answer(message) and parts(message)[0].get("requestId") == 0
    return [] if zero else [message]


@messages("online.plain")
def names_a_manager_in_answers(message: bytes, link: Link) -> list[bytes]:
    return [changed(message, messageManager="OnlineAgentsGetter")] if is_online_answer(message) else [message]


@messages("online.ascending")
def lists_ids_as_they_come(message: bytes, link: Link) -> list[bytes]:
    if not is_online_answer(message):
        return [message]
    metadata, data = parts(message)
    turned = {key: sorted(value, reverse=True) for key, value in json.loads(data).items()}
    return [encode_message(json.dumps(metadata).encode(), json.dumps(turned).encode())]


@messages("frames.bytes_unchanged")
def writes_metadata_anew(message: bytes, link: Link) -> list[bytes]:
    metadata, data = parts(message)
    if not is_from_agent(message) or "colour" not in metadata:
        return [message]
    return [encode_message(json.dumps(metadata, separators=(",", ":")).encode(), data)]


@messages("frames.large")
def cuts_large_messages(message: bytes, link: Link) -> list[bytes]:
    if len(message) < 1 << 19:
        return [message]
    metadata, data = parts(message)
    return [encode_message(json.dumps(metadata).encode(), data[: 1 << 19])]


@messages("frames.no_data")
def loses_what_has_no_data(message: bytes, link: Link) -> list[bytes]:
    return [] if is_from_agent(message) and not parts(message)[1] else [message]


@messages("leaving.go_offline")
def announces_nobody(message: bytes, link: Link) -> list[bytes]:
    return [] if named(message) == "PrunedUnityAgentsInterfaceNodesCleaner" else [message]


@messages("topics.bytes")
def pads_data(message: bytes, link: Link) -> list[bytes]:
    metadata, data = parts(message)
    if not isinstance(metadata, dict) or metadata.get("nodeType") != 1 or metadata.get("senderAgentType") != 1:
        return [message]
    return [encode_message(json.dumps(metadata).encode(), data + bytes(2))]


@messages("calls.answered")
def numbers_answers_anew(message: bytes, link: Link) -> list[bytes]:
    metadata = parts(message)[0]
    answer = isinstance(metadata, dict) and metadata.get("nodeType") == 3 and metadata.get("senderAgentType") == 1
    return [changed(message, requestId=1)] if answer else [message]


def header(frame: bytes) -> tuple[int, list[int], list[int]]:
    return frame[0], [int.from_bytes(frame[at : at + 2], "little") for at in range(1, 21, 2)], list(frame[21:31])


def to_self(frame: bytes, link: Link) -> bytes:
    """What a router would write back to the sender of this frame."""
    return message_of(frame)


@frames("routing.no_echo_of_broadcast")
def echoes_broadcasts(frame: bytes, link: Link) -> list[bytes]:
    if frame[0] == 0 and frame[31:35] == bytes(4):
        link.to_agent.write(to_self(frame, link))
    return [frame]


@frames("routing.ten_ids")
def reads_four_ids(frame: bytes, link: Link) -> list[bytes]:
    return [frame[:9] + bytes(12) + frame[21:]]


@frames("routing.by_group")
def knows_no_groups(frame: bytes, link: Link) -> list[bytes]:
    return [frame[:21] + bytes(10) + frame[31:]]


@frames("routing.id_of_other_type")
def ignores_the_type(frame: bytes, link: Link) -> list[bytes]:
    plain = frame[31:35] == bytes(4) and (parts(message_of(frame))[0] or {}).get("nodeName") == ""
    return [b"\x02" + frame[1:]] if plain and frame[0] == 1 else [frame]


@frames("routing.broadcast_ignores_names")
def minds_names_in_broadcasts(frame: bytes, link: Link) -> list[bytes]:
    named_anyhow = frame[0] == 0 and frame[31:35] == bytes(4) and any(frame[1:31])
    return [b"\x02" + frame[1:]] if named_anyhow else [frame]


@frames("heartbeat.snake_case")
def knows_camel_case_only(frame: bytes, link: Link) -> list[bytes]:
    if "message_manager" in said(frame) and said(frame)["message_manager"] == "HeartbeatHandler":
        link.close()
    return [frame]


@frames("bad.management_unknown_manager")
def closes_on_unknown_managers(frame: bytes, link: Link) -> list[bytes]:
    if said(frame).get("messageManager") == "NoSuchManagerOfAnybody":
        link.close()
    return [frame]


@frames("registering.removed")
def forgets_removals(frame: bytes, link: Link) -> list[bytes]:
    return [] if b"InterfaceNodeRemover" in frame else [frame]


@frames("frames.order")
def lets_one_overtake(frame: bytes, link: Link) -> list[bytes]:
    """Of plain messages every seventh comes behind the next."""
    if frame[0] != 2 or frame[31:35] != bytes(4):
        return [frame]
    link.notes.count = getattr(link.notes, "count", 0) + 1
    if link.notes.count % 7 == 6:
        link.notes.late = frame
        return []
    late = vars(link.notes).pop("late", None)
    return [frame, late] if late else [frame]


def resumed(message: bytes, **other: object) -> list[bytes]:
    """A SessionResumed that says something else; what is none as it is."""
    if named(message) != "SessionResumed":
        return [message]
    metadata, data = parts(message)
    return [encode_message(json.dumps(metadata).encode(), json.dumps({**json.loads(data), **other}).encode())]


@messages("sessions.opened")
def tells_a_short_secret(message: bytes, link: Link) -> list[bytes]:
    metadata, data = parts(message)
    if named(message) != "SessionOpened":
        return [message]
    short = {**json.loads(data), "session": json.loads(data)["session"][:8]}
    return [encode_message(json.dumps(metadata).encode(), json.dumps(short).encode())]


@messages("sessions.not_asked")
def opens_sessions_for_all(message: bytes, link: Link) -> list[bytes]:
    opened = encode_message(json.dumps({"messageManager": "SessionOpened"}).encode(), b'{"session":"a","resumeS":1}')
    return [opened, message] if is_from_agent(message) else [message]


@messages("sessions.same")
def gives_another_id(message: bytes, link: Link) -> list[bytes]:
    own = json.loads(parts(message)[1])["agentId"] if named(message) == "SessionResumed" else 0
    return resumed(message, agentId=own + 1)


@messages("sessions.frames")
def counts_the_configuration(message: bytes, link: Link) -> list[bytes]:
    had = json.loads(parts(message)[1])["received"] if named(message) == "SessionResumed" else 0
    return resumed(message, received=had + 1)


@messages("sessions.missed")
def says_what_was_missed_twice(message: bytes, link: Link) -> list[bytes]:
    link.notes.back = named(message) == "SessionResumed" or getattr(link.notes, "back", False)
    return [message, message] if link.notes.back and is_from_agent(message) else [message]


@frames("sessions.again")
def ignores_what_has_come(frame: bytes, link: Link) -> list[bytes]:
    return [with_management(frame, received=0)] if said(frame).get("received") else [frame]


@frames("sessions.over")
def lets_come_back_who_has_left(frame: bytes, link: Link) -> list[bytes]:
    return [] if said(frame).get("messageManager") == "UnityAgentclientRemover" else [frame]


@frames("sessions.wrong_secret")
def believes_any_secret(frame: bytes, link: Link) -> list[bytes]:
    """Whoever shows one is who was told the last."""
    known = getattr(link.proxy.shared, "secret", None)
    return [with_management(frame, session=known)] if known and said(frame).get("session") else [frame]


def note_secret(message: bytes, link: Link) -> list[bytes]:
    """What `believes_any_secret` has heard."""
    if named(message) == "SessionOpened":
        link.proxy.shared.secret = json.loads(parts(message)[1])["session"]
    return [message]


FAULTS["believes_any_secret"] = FAULTS["believes_any_secret"]._replace(message=note_secret)
