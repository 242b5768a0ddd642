"""What existing programs survive: which messages may go to one that does not say that it is newer. Pure.

The headset in C# and the robot in Python go deaf for good on what they cannot handle, while their connections and
heartbeats go on. What is known of them is in docs/protocol.md and tests/vectors; what is not known to be survived is
not sent. A message is judged by its metadata, whose sender is the true one; `Verdict.data` says what its data must be.

==================  =============================================  ==================================================
message             to a headset                                   to a robot
==================  =============================================  ==================================================
of a router         from its gateway only                          from its gateway only
of a manager        a plain name that is none of the protocol's    none: registrations are written by its gateway
plain               an answer to what it asked, JSON; others where  none
                    they cannot be taken for one
of a node, type 1   a robot on which it registered: CDR of the     none
                    type that it registered
type 2              none                                           nodes that it has, with their type: CDR
type 3              an answer to its request, with its type: CDR   likewise
type 4              as type 1                                      the registrant's answer to its request: CDR
type 5              where it registered such a node, with its type none
==================  =============================================  ==================================================
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple

from msgspec import structs

from .least_bytes import ANSWERS, LEAST, is_whole
from .messages import (
    FOR_NEWER,
    MANAGERS,
    ROS,
    AccessRefused,
    AddNode,
    AgentsGone,
    CallFailure,
    Metadata,
    NodeRefused,
    NodeType,
    SessionOpened,
    SessionResumed,
    Welcome,
    is_json_object,
)
from .offers import short_type
from .wire import Buffer, Frame, Frames, Header, encode_message

CDR = b"\x00\x01\x00\x00"
"""How ROS 2 data begins. A message without fields is this and nothing more as Unity writes it, and longer by a byte as
ROS does. Existing programs get the latter: they go deaf on a message that has fields and ends here."""

_TOPICS, _REQUESTS, _ANSWERS = (
    frozenset({"std_msgs/Empty"}),
    frozenset({"std_srvs/Empty", "std_srvs/Trigger"}),
    frozenset({"std_srvs/Empty"}),
)
"""Types whose messages are known to have no fields. Of others `CDR` alone is taken for one that is cut short."""

ROUTER_ONLY = frozenset(
    kind.manager for kind in (Welcome, AgentsGone, NodeRefused, AccessRefused, SessionOpened, SessionResumed)
)
"""What only a router says: no agent says it to a TCP agent, newer or not."""

CLASSES = frozenset(
    {
        "managementmessagemanager",  # the base of its managers: it was created and went deaf, three times of three
        "interfacenode",
        "interfacepublishernode",
        "interfacesubscribernode",
        "interfaceservicenode",
        "interfaceclientnode",
        "messageserializer",
        "messagedeserializer",
        "routingdata",
        "routingdataconfiguration",
        "metadata",
        "unityagent",
        "unityagentclient",
        "rosagent",
    }
)
"""Classes of the existing headset that are no managers, in small letters. It looks up a class by a manager's name."""

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,254}")

AgentKey = tuple[int, int]

SUBSCRIBER, PUBLISHER, CLIENT, SERVICE, ACTION = (int(kind) for kind in NodeType)


class Data(Enum):
    """What the data of a message must be for its receiver."""

    ANY = "anything"
    CDR = "a ROS 2 message"
    EMPTY_TOO = "a ROS 2 message, or one without fields as Unity writes it"
    JSON = "a JSON object"
    FAILURE_TOO = "a ROS 2 message, or why there is none"


class Verdict(NamedTuple):
    """Whether a message may go to an agent: with a ``name`` it may not, and is counted under it."""

    name: str = ""
    why: str = ""
    data: Data = Data.ANY
    stays: bool = True
    """Whether the next message with this metadata, of whatever request id, is judged alike, until the agent registers
    or asks something."""
    answers: bool = False
    """Whether it answers a request: a second one would not."""


PASS = Verdict()
PASS_ONCE = Verdict(stays=False)


def _no(name: str, why: str, *, stays: bool = True) -> Verdict:
    return Verdict(name, why, stays=stays)


def _answer(data: Data) -> Verdict:
    return Verdict(data=data, stays=False, answers=True)


class OwnNode(NamedTuple):
    """An interface node of an existing headset, which reads what comes for it as the type that it has itself."""

    node_type: int
    data_type: str
    """As `short_type` writes it."""


_KEYS = {
    "senderAgentType": int,
    "senderAgentId": int,
    "requestId": int,
    "messageManager": str,
    "nodeType": int,
    "nodeName": str,
    "dataExchangeType": str,
}
_FOLDED = frozenset(key.casefold() for key in _KEYS)


def readable(metadata: bytes) -> bool:
    """Whether existing programs find in metadata JSON what we find in it: each of the seven keys once, as number or
    text, and no other key that they may take for one of them."""
    try:
        pairs = json.loads(metadata, object_pairs_hook=list)
    except (ValueError, RecursionError):
        return False
    folded = sum(key.replace("_", "").casefold() in _FOLDED for key, _ in pairs)
    fields = dict(pairs)
    return folded == len(_KEYS) and all(type(fields.get(key)) is kind for key, kind in _KEYS.items())


# -- who asked what --------------------------------------------------------------------------------------------------


class _Question(NamedTuple):
    failures: bool
    """Whether the asker understands a `CallFailure`."""
    data_type: str


class Asked:
    """Requests of one TCP agent that may still be answered: plain ones, and calls of services.

    An existing program takes whatever carries the request's number for the answer, so it must come from whom it asked.
    """

    LIMIT = 1024

    def __init__(self) -> None:
        self._open: dict[tuple[str, int, AgentKey], _Question] = {}
        """By node name, request id and who was asked."""
        self._plain: dict[int, int] = {}
        """How many were asked the plain request of this number."""

    def note(self, metadata: Metadata, header: Header) -> None:
        """The agent sends a request."""
        to = [(header.agent_type, agent_id) for agent_id in header.ids] if header.agent_type else []
        if header.groups or not header.agent_type:
            to.append(ANYBODY)
        question = _Question(metadata.message_manager == CallFailure.manager, metadata.data_exchange_type)
        for agent in to:
            self._forget((metadata.node_name, metadata.request_id, agent))
            self._open[metadata.node_name, metadata.request_id, agent] = question
            if not metadata.node_name:
                self._plain[metadata.request_id] = self._plain.get(metadata.request_id, 0) + 1
        while len(self._open) > self.LIMIT:
            self._forget(next(iter(self._open)))

    def awaits(self, answer: Metadata) -> Data | None:
        """What an answer must be, by its metadata; None for one that nobody asked for."""
        question = self._question(answer)
        if question is None:
            return None
        if not answer.node_name:
            return Data.JSON
        understands = question.failures and answer.message_manager == CallFailure.manager
        return Data.FAILURE_TOO if understands else Data.CDR

    def type_asked(self, answer: Metadata) -> str:
        """Which type the question names that this answers."""
        question = self._question(answer)
        return question.data_type if question is not None else ""

    def awaits_another(self, message: Metadata) -> bool:
        """Whether a plain message would be taken for the answer to what somebody else was asked."""
        return message.request_id in self._plain

    @property
    def plainly(self) -> bool:
        """Whether a plain request is open: what a plain message is depends on its number then."""
        return bool(self._plain)

    def answered(self, answer: Metadata) -> None:
        """An answer was passed on: the next one like it answers nothing."""
        self._forget((answer.node_name, answer.request_id, _sender(answer)))

    def _question(self, answer: Metadata) -> _Question | None:
        about = answer.node_name, answer.request_id
        return self._open.get((*about, _sender(answer))) or self._open.get((*about, ANYBODY))

    def _forget(self, key: tuple[str, int, AgentKey]) -> None:
        if self._open.pop(key, None) is not None and not key[0]:
            left = self._plain[key[1]] - 1
            if left:
                self._plain[key[1]] = left
            else:
                del self._plain[key[1]]


ANYBODY: AgentKey = (0, 0)
"""Whom a request to a group or to everybody goes to."""


def asks(metadata: Metadata) -> bool:
    """Whether a message that an agent sends may be answered by its request id."""
    if metadata.node_name:
        return metadata.node_type in (CLIENT, SERVICE)
    return bool(metadata.message_manager)


# -- verdicts --------------------------------------------------------------------------------------------------------


def to_newer(metadata: Metadata, nodes: Mapping[str, set[int]]) -> Verdict:
    """A message to a TCP agent that says it is newer; ``nodes`` are those that it registered."""
    types = nodes.get(metadata.node_name) if metadata.node_name else None
    if types is not None and metadata.node_type not in types:
        return _wrong_type(metadata)
    if not metadata.node_name and (wrong := _name_problem(metadata.message_manager)):
        return _no("forbidden_manager", wrong)
    return PASS


def to_headset(metadata: Metadata, nodes: Mapping[str, OwnNode], asked: Asked, *, registered_there: bool) -> Verdict:
    """A message to an existing headset; ``nodes`` are its own by name, ``registered_there`` says whether the message's
    node is registered on the sender."""
    if metadata.node_name:
        return _node_to_headset(metadata, nodes.get(metadata.node_name), asked, registered_there)
    manager = metadata.message_manager
    if manager:
        wrong = _name_problem(manager)
        if not wrong and (manager in MANAGERS or manager.lower() in CLASSES):
            wrong = f"{manager} is a class of an existing headset that takes no messages of agents"
        if not wrong and manager in FOR_NEWER:
            wrong = f"an existing headset has no {manager}"
        return _no("forbidden_manager", wrong) if wrong else PASS
    wanted = asked.awaits(metadata)
    if wanted is not None:
        return _answer(wanted)
    if asked.awaits_another(metadata):
        return _no("not_asked", "an answer that it awaits from somebody else", stays=False)
    return PASS_ONCE if asked.plainly else PASS  # until it asks something


def _node_to_headset(metadata: Metadata, own: OwnNode | None, asked: Asked, registered_there: bool) -> Verdict:
    kind = metadata.node_type
    if own is not None and kind != own.node_type:
        return _wrong_type(metadata)
    if metadata.sender_agent_type != ROS:
        if own is None:
            return PASS  # for no node of it: ignored
        return _no("not_from_robot", f"{_node(metadata)} takes messages of robots only")
    if own is not None and kind != CLIENT and not _is_of(own.data_type, metadata):
        return _other_type(metadata, own.data_type)
    if kind in (SUBSCRIBER, SERVICE):
        if registered_there:
            return Verdict(data=_data(metadata, _TOPICS if kind == SUBSCRIBER else _REQUESTS), stays=False)
        return _no("not_registered", f"a message of {_node(metadata)}, which it has not registered there", stays=False)
    if kind == CLIENT:
        wanted = asked.awaits(metadata)
        if wanted is not None:
            if not _is_of(data_type := asked.type_asked(metadata), metadata):
                return _other_type(metadata, data_type, stays=False)
            return _answer(_data(metadata, _ANSWERS) if wanted is Data.CDR else wanted)
        return _no("not_asked", f"an answer of {_node(metadata)} that it has not asked for", stays=False)
    if kind == ACTION and own is not None:
        return PASS  # who registers one is written for it
    return _no("unknown_node", f"a message of {_node(metadata)}, which is for no headset")


def to_robot(metadata: Metadata, node: AddNode | None, asked: Asked) -> Verdict:
    """A message to an existing robot program; ``node`` is what was registered under its node's name and type."""
    name, kind = metadata.node_name, metadata.node_type
    if not name:
        what = f"messages of {metadata.message_manager}" if metadata.message_manager else "plain messages"
        return _no("not_survived", f"an existing robot program does not survive {what}")
    if kind not in (PUBLISHER, CLIENT, SERVICE):
        return _no("not_survived", f"an existing robot program takes no messages of {_node(metadata)}")
    if node is None:
        return _no("unknown_node", f"nobody registered {_node(metadata)} there")
    if metadata.data_exchange_type != node.data_exchange_type:
        return _other_type(metadata, node.data_exchange_type)
    data = _data(metadata, {PUBLISHER: _TOPICS, CLIENT: _REQUESTS, SERVICE: _ANSWERS}[kind])
    if kind == SERVICE:
        if _sender(metadata) != (node.registrant_agent_type, node.registrant_agent_id):
            return _no("not_registered", f"an answer of {_node(metadata)} by who does not serve it", stays=False)
        if asked.awaits(metadata) is None:
            return _no("not_asked", f"an answer of {_node(metadata)} that it has not asked for", stays=False)
        return _answer(data)
    return Verdict(data=data)


def _data(metadata: Metadata, without_fields: frozenset[str]) -> Data:
    return Data.EMPTY_TOO if short_type(metadata.data_exchange_type) in without_fields else Data.CDR


def _is_of(data_type: str, metadata: Metadata) -> bool:
    """Whether a message says that it is of this type: as existing programs write it, or as ROS does."""
    said = metadata.data_exchange_type
    return said == data_type or short_type(said) == short_type(data_type)


def least_bytes(metadata: Metadata) -> int:
    """How long the data of a node's message must be at least, as far as that is known."""
    if metadata.node_type in (SUBSCRIBER, PUBLISHER):
        return LEAST.get(metadata.data_exchange_type, 0)
    answers = metadata.node_type == (CLIENT if metadata.sender_agent_type == ROS else SERVICE)
    return ANSWERS.get(metadata.data_exchange_type, 0) if answers else 0


def fitting(frame: Frames, data: Data, metadata: Metadata) -> tuple[Sequence[Buffer], int]:
    """The messages of a frame, or of a run, whose data is as it must be; and how many are not."""
    if metadata.data_exchange_type.count("/") > 1:
        metadata = structs.replace(metadata, data_exchange_type=short_type(metadata.data_exchange_type))
    good: list[Buffer] = []
    for single in frame.each():
        if (message := _fitting(single, data, metadata)) is not None:
            good.append(message)
    return good, frame.count - len(good)


def _fitting(frame: Frame, data: Data, metadata: Metadata) -> Buffer | None:
    if data is not Data.JSON and frame.carries(CDR, least_bytes(metadata)):
        return frame.message if is_whole(frame.body, metadata.data_exchange_type) else None
    if data is Data.EMPTY_TOO and frame.body == CDR:
        return encode_message(frame.metadata, CDR + b"\x00")  # as ROS writes it, which is what ROS reads
    if data in (Data.JSON, Data.FAILURE_TOO) and is_json_object(frame.body):
        return frame.message
    return None


def refuses(frame: Frame) -> bool:
    """Whether a plain answer is a `Refusal`."""
    return bytes(frame.body[:10]) == b'{"refused"'


def _name_problem(manager: str) -> str:
    """Why a manager's name never goes from an agent to a TCP agent; empty for one that may."""
    if manager in ROUTER_ONLY:
        return f"{manager} is for a router to say"
    if manager and not _IDENTIFIER.fullmatch(manager):
        return f"{manager[:80]!r} is no name of a manager"
    return ""


def _wrong_type(metadata: Metadata) -> Verdict:
    return _no("wrong_node_type", f"a message for its node {_node(metadata)}, which has another type there")


def _other_type(metadata: Metadata, data_type: str, *, stays: bool = True) -> Verdict:
    types = f"{metadata.data_exchange_type[:80] or 'no type'}, and {_node(metadata)} has {data_type[:80] or 'none'}"
    return _no("other_type", f"a message with {types}", stays=stays)


def _node(metadata: Metadata) -> str:
    return f"{metadata.node_name[:80]} of type {metadata.node_type}"


def _sender(metadata: Metadata) -> AgentKey:
    return (metadata.sender_agent_type or 0, metadata.sender_agent_id or 0)
