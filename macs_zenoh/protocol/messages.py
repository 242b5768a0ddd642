"""Metadata and management data as typed values; JSON as the existing programs write it.

Existing programs spell top-level keys in camelCase, UpperCamelCase or snake_case, in any order, with keys missing
or unknown ones added. All of that is accepted; a value of the wrong type is not. What we write is compact camelCase,
as headsets do.

The wire calls the kinds of management data *managers* and names a class for each. Here each kind is a struct named
for what it says, with the wire's name in ``manager``.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum, IntEnum
from functools import lru_cache
from typing import Annotated, ClassVar, NamedTuple

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from ..errors import BadField, BadJson, TooLong, UnknownManager
from .json_fields import StructT, converted, fields_of, json_object, judged, snake, snake_object, wire_names
from .limits import CONFIGURATION_BYTES, MANAGEMENT_BYTES, METADATA_BYTES, NAME_BYTES, REQUEST_BYTES

EVERYBODY = 0
"""Agent type of a header that goes to everybody."""
ROS = 1
"""Agent type of robots."""
UNITY = 2
"""Agent type of headsets."""
OPERATOR = 255
"""Agent type of people who watch and stop robots, with `macs ls` and `macs stop`. No TCP agent has it."""

NOBODY = 254
"""Agent type of nobody: with an operator's certificate `macs doctor` tries as one whether tokens are seen."""

EXTENSIONS = 1
"""The version of our extensions of the protocol that this package's agents understand; existing programs: 0."""

AgentType = Annotated[int, Meta(ge=0, le=255)]
AgentId = Annotated[int, Meta(ge=0, le=0xFFFF)]
GroupId = Annotated[int, Meta(ge=0, le=255)]
RequestId = Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]
Count = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]

PLAIN = r"^[^\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]*\Z"
"""Text without control characters and without those that turn the direction of writing."""

Name = Annotated[str, Meta(max_length=NAME_BYTES, pattern=PLAIN)]
"""Of a topic, service, type or manager; it may be empty where there is none."""
NodeName = Annotated[str, Meta(min_length=1, max_length=NAME_BYTES, pattern=PLAIN)]
"""Of an interface node: a part of keys."""


ClockName = Annotated[str, Meta(min_length=1, max_length=32, pattern=r"^[0-9a-z]*\Z")]
"""Of the clock by which an agent tells when it made its commands."""


class NodeType(IntEnum):
    """What an interface node is on the robot. MACS's own texts name 3 and 4 from the headset's side."""

    SUBSCRIBER = 1
    """A ROS subscription: a robot's topic goes to headsets."""
    PUBLISHER = 2
    """A ROS publisher: headsets' data goes to a robot's topic."""
    CLIENT = 3
    """A ROS service client: a headset calls a service that runs on the robot."""
    SERVICE = 4
    """A ROS service: a node on the robot calls a service that runs on a headset."""
    ACTION = 5
    """A ROS action client: a headset gives goals to an action that runs on the robot (docs/actions.md)."""


class ActionVerb(str, Enum):
    """What a message of an action's interface node says, in place of a manager (docs/actions.md)."""

    GOAL = "ActionGoal"
    ACCEPTED = "ActionAccepted"
    FEEDBACK = "ActionFeedback"
    RESULT = "ActionResult"
    CANCEL = "ActionCancel"
    LIST = "ActionList"


class Metadata(Struct, frozen=True, rename="camel", forbid_unknown_fields=True):
    """The JSON in front of every message's data. A router leaves the sender null; request id 0 is a real id.

    Unknown keys are forbidden to the fast decoder only: it would skip their values unread, and receivers go deaf on
    what was not read (bytes that are no UTF-8, numbers and nesting without end).
    """

    sender_agent_type: AgentType | None = None
    sender_agent_id: AgentId | None = None
    request_id: RequestId = 0
    message_manager: Name = ""
    node_type: Annotated[int, Meta(ge=0, le=255)] = 0
    node_name: Name = ""
    data_exchange_type: Name = ""
    clock: ClockName | UnsetType = UNSET
    """Of a command: the request id is the time on this clock at which it was made (`command_clock`)."""

    @staticmethod
    def decode(data: bytes | bytearray | memoryview) -> Metadata:
        """Read metadata JSON. Raises TooLong, BadJson or BadField."""
        if len(data) > METADATA_BYTES:
            raise TooLong("metadata", len(data), METADATA_BYTES)
        try:
            return _metadata_decoder.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            # other keys than the plain ones: the tolerant way reads all of it, or tells what is wrong
            try:
                return converted("metadata", snake_object("metadata", bytes(data)), Metadata)
            except BadJson:
                raise BadJson("metadata", str(error)) from error

    def encode(self) -> bytes:
        """Write compact JSON with all seven keys, and the clock where there is one."""
        return msgspec.json.encode(self)

    def sent_by(self, agent_type: int, agent_id: int) -> Metadata:
        """The same with this sender, itself when it names it already."""
        if self.sender_agent_id == agent_id and self.sender_agent_type == agent_type:
            return self
        return msgspec.structs.replace(self, sender_agent_type=agent_type, sender_agent_id=agent_id)

    def numbered(self, request_id: int) -> Metadata:
        """The same with another request id."""
        return msgspec.structs.replace(self, request_id=request_id)


_metadata_decoder = msgspec.json.Decoder(Metadata)


class Functionality(Struct, frozen=True, rename="camel"):
    """What a robot offers: topic or service name -> type, e.g. ``{"/chatter": "std_msgs/msg/String"}``."""

    subscribers: dict[str, str] = {}
    publishers: dict[str, str] = {}
    services: dict[str, str] = {}


class Management(Struct, frozen=True, rename="camel"):
    """Base of everything that names a manager."""

    manager: ClassVar[str] = ""


class Welcome(Management, frozen=True):
    """Router → each new connection, at once: your id. Metadata's request id is the number of the connection."""

    manager: ClassVar[str] = "AgentConfigurer"
    agent_id: AgentId


class Configuration(Management, frozen=True):
    """Agent → router: the answer to Welcome. ``request_id`` echoes it; robots add what they offer.

    ``extensions`` is the version of our extensions that the agent understands. Without it, it is an existing program:
    its gateway sends it only what those are known to survive. ``token`` says what the agent may (docs/security.md).
    ``session`` says that the agent comes back when its connection ends, and when it does it is the secret of its
    session; ``received`` is how many messages of that it has. Existing routers ignore all of these keys.
    """

    manager: ClassVar[str] = "AgentclientConfigurer"
    agent_type: AgentType
    agent_id: AgentId
    group_id: GroupId = 0
    request_id: RequestId = 0
    functionality: Functionality | None = None
    extensions: Annotated[int, Meta(ge=0, le=0xFFFF)] = 0
    token: str | None = None
    session: str | None = None
    received: Count = 0


class Heartbeat(Management, frozen=True):
    """Agent → router, after 5 s without other output. ``received`` is how many messages of its session it has."""

    manager: ClassVar[str] = "HeartbeatHandler"
    received: Count | None = None


class OnlineRequest(Management, frozen=True):
    """Headset → router: who is online? The answer goes to the asking connection with its request id."""

    manager: ClassVar[str] = "OnlineAgentsGetter"
    agent_type: AgentType = UNITY
    agent_id: AgentId = 0


class OnlineReply(Struct, frozen=True, rename="camel"):
    """Router → asker, in the data part."""

    ros_agent_ids: list[AgentId] = []
    unity_agent_ids: list[AgentId] = []


class Registration(Management, frozen=True):
    """Headset → router → robots: add or remove an interface node. The message inside says which, and is judged: the
    names here are only for telling who sent it."""

    manager: ClassVar[str] = "RosAgentNodeRegistrationForwarder"
    registrant_agent_id: AgentId
    node_type: Annotated[int, Meta(ge=0, le=255)]
    node_name: str
    registrar_agent_ids: list[AgentId] = []
    registrar_group_ids: list[GroupId] = []
    tos_name: str = ""
    data_exchange_type: str = ""


class AddNode(Management, frozen=True):
    """Headset → robot: create this interface node, or register me on it. ``tos_name`` is the topic or service.

    ``unity_cdr``: my data is CDR as Unity's serializer writes and reads it. For existing headsets their gateway says
    so; existing robots are not told.
    """

    manager: ClassVar[str] = "InterfaceNodeAdder"
    registrant_agent_type: AgentType
    registrant_agent_id: AgentId
    node_type: Annotated[int, Meta(ge=0, le=255)]
    node_name: NodeName
    tos_name: Name
    data_exchange_type: Name
    buffer_size: Annotated[int, Meta(ge=0, le=0x7FFFFFFF)] = 10
    drop_new: bool = False
    is_latched: bool = False
    unity_cdr: bool | UnsetType = UNSET


class RemoveNode(Management, frozen=True):
    """Headset → robot: take me off this interface node."""

    manager: ClassVar[str] = "InterfaceNodeRemover"
    registrant_agent_type: AgentType
    registrant_agent_id: AgentId
    node_type: Annotated[int, Meta(ge=0, le=255)]
    node_name: NodeName


_TYPES = {str(number): number for number in range(1, 256)}


class StreamData(Management, frozen=True):
    """Robot → router → headsets: topic data for these registrants: agent type as a string → ids, any number."""

    manager: ClassVar[str] = "RosAgentSubscriberDataForwarder"
    dest_agents: dict[str, list[AgentId]]

    def targets(self) -> list[tuple[int, int]]:
        """(type, id) of each registrant; types that are no agent types are left out."""
        return [
            (_TYPES[kind], agent_id) for kind, ids in self.dest_agents.items() if kind in _TYPES for agent_id in ids
        ]


class GoOffline(Management, frozen=True):
    """Headset → router: I leave."""

    manager: ClassVar[str] = "UnityAgentclientRemover"
    agent_id: AgentId = 0


class GoneAgent(Struct, frozen=True):
    """One entry of AgentsGone; on the wire in snake_case."""

    agent_type: AgentType
    agent_id: AgentId


class AgentsGone(Management, frozen=True):
    """Router → all agents: these are no longer online. Lists robots too."""

    manager: ClassVar[str] = "PrunedUnityAgentsInterfaceNodesCleaner"
    agents: list[GoneAgent]


class NodeRefused(Management, frozen=True):
    """Router → headset, ours: a robot refused an interface node. Existing programs have no such manager."""

    manager: ClassVar[str] = "InterfaceNodeRefused"
    robot_id: AgentId
    node_type: Annotated[int, Meta(ge=0, le=255)]
    node_name: str
    tos_name: str
    reason: str


class AccessRefused(Management, frozen=True):
    """Gateway → agent, ours: what its token, or the lack of one, does not permit. Existing programs ignore it.

    ``kind`` is ``no_token``: no valid token was shown where one is wanted, and the connection ends; ``not_permitted``:
    a message was not passed on; ``changed``: the token has other rights now; ``ended``: it holds no longer, and the
    connection ends; ``stops``: the gateway does, and so do all connections. ``reason`` is for a person, ``request_id``
    that of the message.
    """

    manager: ClassVar[str] = "AccessRefused"
    kind: str
    reason: str
    request_id: RequestId = 0


class SessionOpened(Management, frozen=True):
    """Gateway → agent that says that it comes back, ours: the secret by which it is known then, for ``resume_s`` after
    its connection has ended. To who showed another secret it says that it is a new agent, whatever was wrong."""

    manager: ClassVar[str] = "SessionOpened"
    session: str
    resume_s: float = 0.0


class SessionResumed(Management, frozen=True):
    """Gateway → agent that showed the secret of its session, ours: it is the same agent as before, with this id.

    ``received`` is how many frames of the session have come; all behind them have to be sent again, if they are still
    meant. ``gap``: of what the agent has not received something could not be kept.
    """

    manager: ClassVar[str] = "SessionResumed"
    agent_id: AgentId
    received: Count = 0
    gap: bool = False


class DataRefused(Struct, frozen=True, rename="camel"):
    """Robot → agent: what it sent for an interface node was not taken, and why. For agents that know our extensions.

    ``kind`` is the name under which the robot counts it, as ``stopped``, ``not_in_control``, ``not_allowed``,
    ``bad_cdr`` or ``no_node``; ``reason`` is for a person. Told at once, and again while more of it comes. With
    ``other_type`` nothing was sent: the topic or service has another type now, and the node is of no use.
    """

    manager: ClassVar[str] = "InterfaceDataRefused"
    robot_id: AgentId
    node_type: Annotated[int, Meta(ge=0, le=255)]
    node_name: str
    tos_name: str
    kind: str
    reason: str


OTHER_TYPE = "other_type"


class CommandClock(Struct, frozen=True, rename="camel"):
    """Between a robot and an agent that tells when it made its commands (`command_clock`).

    From the agent: with a ``clock`` alone it says hello; with a ``question``'s number and ``at``, the time on that
    clock, it answers. From the robot: a ``question``, 0 for none; whether the clock is ``known``, so that commands
    pass; and how old these may be.
    """

    manager: ClassVar[str] = "CommandClock"
    clock: ClockName
    question: Annotated[int, Meta(ge=0, le=(1 << 53) - 1)] = 0
    at: Annotated[int, Meta(ge=0, le=(1 << 53) - 1)] | UnsetType = UNSET
    known: bool | UnsetType = UNSET
    max_age_s: float | UnsetType = UNSET


class CallFailure(Struct, frozen=True, rename="camel"):
    """In place of a service's response, in the data part: why there is none. Metadata names it as the manager.

    Sent only to who asked for it, by naming this manager in the metadata of the request: an existing program would
    take it for the response. ``kind`` is ``absent``, ``timeout``, ``invalid``, ``refused`` or ``failed``; ``reason``
    is for a person.
    """

    manager: ClassVar[str] = "InterfaceCallFailure"
    kind: str
    reason: str


class Refusal(Struct, frozen=True):
    """In place of an answer to a plain request, in the data part: why there is none, for a person."""

    refused: str


class FunctionalityRequest(Management, frozen=True):
    """Anyone → robot: report your topics and services."""

    manager: ClassVar[str] = "FunctionalityGetter"


MANAGERS: dict[str, type[Management]] = {kind.manager: kind for kind in Management.__subclasses__()}
"""Every manager by its name on the wire. Nothing is ever imported or created because a message names it."""

FOR_NEWER = frozenset({DataRefused.manager, CommandClock.manager})
"""Managers of messages between agents that existing programs do not have: not for who does not know our extensions."""

NO_CUSTOM: Mapping[str, type[Struct]] = {}


class Custom(NamedTuple):
    """Management data of a manager that somebody added: its name and its typed data."""

    manager: str
    data: Struct


def decode_management(
    data: bytes, custom: Mapping[str, type[Struct]] = NO_CUSTOM, max_bytes: int = MANAGEMENT_BYTES
) -> Management | Custom:
    """Read management data; ``custom`` has the managers that somebody added.

    Raises TooLong, BadJson, BadField or UnknownManager.
    """
    fields = snake_object("management data", judged("management data", data, max_bytes))
    name = fields.pop("message_manager", None)
    if not isinstance(name, str):
        raise BadField("management data", "the key 'messageManager' is missing or not a string")
    if (kind := MANAGERS.get(name)) is not None:
        return converted(name, fields, kind)
    if name in custom:
        return Custom(name, converted(name, fields, custom[name]))
    raise UnknownManager(name)


def encode_management(value: Management) -> bytes:
    """Write management data: the value's fields and its manager's name."""
    fields = {**fields_of(value), "messageManager": value.manager}
    if isinstance(value, Configuration) and not value.extensions:
        del fields["extensions"]  # as existing programs write it
    if isinstance(value, Configuration) and not value.received:
        del fields["received"]
    return msgspec.json.encode(fields)


def decode_data(kind: type[StructT], data: bytes | bytearray | memoryview, max_bytes: int = REQUEST_BYTES) -> StructT:
    """Read the JSON in a message's data part as ``kind``. Raises TooLong, BadJson or BadField."""
    name = getattr(kind, "manager", "") or kind.__name__
    data = judged(name, data, max_bytes)
    return converted(name, snake_object(name, data), kind)


def is_json_object(data: bytes | bytearray | memoryview, max_bytes: int = CONFIGURATION_BYTES) -> bool:
    """Whether data is a JSON object, of a size that may be parsed."""
    try:
        json_object("data", judged("data", data, max_bytes))
    except (TooLong, BadJson):
        return False
    return True


def encode_data(value: Struct) -> bytes:
    """Write a message's data part."""
    return msgspec.json.encode(value)


_SENDER = frozenset(("senderagenttype", "senderagentid"))


def correct_sender(metadata: bytes, agent_type: int, agent_id: int) -> bytes:
    """The same metadata JSON with its true sender and our keys in camelCase, itself when it is so already; unknown
    keys are kept. Raises TooLong or BadJson.

    Keys that are the sender's to a reader who takes small and capital letters for the same are not kept.
    """
    fields = json_object("metadata", judged("metadata", metadata, METADATA_BYTES))
    names = wire_names(Metadata)
    true = {}
    for key, value in fields.items():
        name = names.get(snake(key))
        if name is not None or key.casefold() not in _SENDER:
            true[name or key] = value
    true |= {"senderAgentType": agent_type, "senderAgentId": agent_id}
    return metadata if true == fields else msgspec.json.encode(true)


@lru_cache(maxsize=1024)
def node_name(tos_name: str) -> str:
    """The name of the interface node for a topic or service: ``/cmd_vel`` → ``nd__cmd_vel``. Names can collide."""
    return "nd_" + tos_name.replace("/", "_").replace("~", "_")
