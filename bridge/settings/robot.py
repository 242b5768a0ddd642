"""What a settings file may say of `macs agent`: of a robot, and of its topics, services and actions by name. Pure."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from macs_zenoh.config import Priority
from macs_zenoh.protocol.guard import STOP_TOPIC
from macs_zenoh.protocol.name_patterns import PATTERN
from macs_zenoh.sections import AgentId, Bytes, GroupId, Seconds, Section, in_words

from .agents import AgentPattern, names_agents
from .mirror import MirrorRule

NamePattern = Annotated[
    str,
    Meta(
        pattern=PATTERN,
        max_length=256,
        extra=in_words("a full name that begins with /, as /camera/image, /camera/* or /camera/**"),
    ),
]
"""A full ROS name in which ``*`` stands for anything within one level and ``**`` for any number of levels."""
TopicOrNone = Annotated[
    str,
    Meta(
        pattern=r"^(/[A-Za-z_]\w*)*$",
        extra=in_words("the full name of a topic, which begins with /, or nothing"),
    ),
]


class AsJpeg(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How pictures are made of a raw image topic."""

    section: ClassVar[str] = "robot.rules.as_jpeg"

    quality: Annotated[int, Meta(ge=1, le=100)] = 80
    """Of JPEG."""
    max_width: Annotated[int, Meta(ge=0, le=65_535)] = 0
    """In pixels: of wider images groups of 2 x 2, 3 x 3 and so on become one each. 0: as they are."""
    max_hz: Annotated[float, Meta(gt=0, le=1000)] = 30.0
    """At most so many pictures per second, the latest."""


class TopicRule(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What holds for topics, services and actions whose full name fits a pattern; one ``[[robot.rules]]`` table.

    Of several rules that fit a name, each setting comes from the first one that gives it.
    """

    section: ClassVar[str] = "robot.rules"

    match: NamePattern
    """As ``/camera/*`` (one level) or ``/camera/**`` (any levels below)."""

    reliability: Literal["best_effort", "reliable"] | None = None
    """QoS of ROS, in place of what the topic's other endpoints have."""
    durability: Literal["volatile", "transient_local"] | None = None
    """The same."""
    depth: Annotated[int, Meta(ge=1, le=1000)] | None = None
    """The same, in place of the registration's ``bufferSize``."""
    max_hz: Annotated[float, Meta(gt=0, le=10_000)] | None = None
    """Topic data to headsets: at most so many messages per second; of those in between, the latest is sent."""
    priority: Priority | None = None
    """Topic data to headsets: its priority on the mesh instead of ``data``. It wins over a `TrafficRule`."""
    cache: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    """Topic data to headsets: keep the last so many messages, and send those again that a gateway missed while the
    mesh was interrupted (docs/reliable.md). It has nothing to do with ROS QoS, and wins over a `TrafficRule`."""
    as_jpeg: AsJpeg | None = None
    """Of a topic of sensor_msgs/Image: pictures of it on ``<name>/compressed``, made while somebody takes them. Needs
    ``macs-zenoh[jpeg]``. ``as_jpeg = {}`` takes the defaults."""
    read_only: bool | None = None
    """Headsets may subscribe to the topic, not publish to it."""

    call_timeout_s: Seconds | None = None
    """How long a service may take, on either side; for actions, how long a goal may wait to be accepted."""
    error_response: dict[str, Any] | None = None
    """Fields of the response that a ROS caller gets when a headset does not answer."""
    cancel_on_leave: bool | None = None
    """Cancel an action's goals when the headset that gave them leaves."""

    exclusive: bool | None = None
    """One agent commands this topic at a time."""
    hold_s: Seconds | None = None
    """Control without a command for so long is free for others; 3 s unless set."""
    deadman_s: Seconds | None = None
    """Without a command for so long, `deadman_message` is published once."""
    deadman_message: dict[str, Any] | None = None
    """The fields that are not zero; published also when the commanding agent leaves, and at an emergency stop."""
    allow_while_stopped: bool | None = None
    """Commands, calls and goals pass although the emergency stop holds: for what moves nothing."""

    def _check(self) -> None:
        if self.deadman_s is not None and self.deadman_message is None:
            raise self._wrong("deadman_s", "needs a deadman_message; {} is a message with every field zero")


WHO_STOPPED = "who_stopped"
"""In `RobotSettings.release_allow`: whoever pressed the emergency stop may take that back."""

ROBOT_HIDES = (
    "/rosout",
    "/parameter_events",
    "/**/describe_parameters",
    "/**/get_parameter_types",
    "/**/get_parameters",
    "/**/list_parameters",
    "/**/set_parameters",
    "/**/set_parameters_atomically",
    "/**/get_type_description",
)
"""What every ROS node brings along: a headset that could set the parameters of any node would own the robot."""


class RobotSettings(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The robot agent beside a ROS 2 graph."""

    section: ClassVar[str] = "robot"

    id: AgentId | None = None
    """Unset: lease a free one. Headsets address robots by number, so a robot in use has a fixed one."""
    group: GroupId = 0
    """The group that the robot is in, 1 to 255. 0: in none."""
    max_nodes: Annotated[int, Meta(ge=1, le=10_000)] = 256
    """Interface nodes that headsets may have registered here at one time."""
    managers: list[str] = []
    """Own management messages, as for the gateway (docs/managers.md)."""
    expose: list[NamePattern] = msgspec.field(default_factory=lambda: ["/**"])
    """Topics, services and actions that headsets may use; existing programs name them freely, so all by default."""
    hide: list[NamePattern] = msgspec.field(default_factory=lambda: list(ROBOT_HIDES))
    """Except these."""
    call_timeout_s: Seconds = 5.0
    """How long a service may take unless a rule says otherwise; existing headsets wait 5 s."""
    max_calls: Annotated[int, Meta(ge=1, le=100_000)] = 1024
    """Calls that may be open on one service at one time."""
    result_timeout_s: Annotated[float, Meta(gt=0, le=604_800)] = 900.0
    """How long the result of an action is kept for a headset that has lost its connection."""
    stop_topic: TopicOrNone = STOP_TOPIC
    """The emergency stop: true on this topic (std_msgs/Bool) stops, false releases. Empty: there is none."""
    stop_allow: list[AgentPattern] = msgspec.field(default_factory=lambda: ["*"])
    """Who may stop: ``*``, ``unity``, ``unity/5``, ``block/1`` (headsets of this block of ids), ``group/3`` or
    ``operator/5`` (`macs stop --as`)."""
    release_allow: list[AgentPattern] = msgspec.field(default_factory=lambda: ["operator", WHO_STOPPED])
    """Who may release a stop, whoever pressed it; ``who_stopped`` takes back its own, as long as it is online."""
    register_allow: list[AgentPattern] = msgspec.field(default_factory=lambda: ["*"])
    """Who may register to publish, to call, to serve and to give goals. Others may register for topics only."""
    max_commands_per_s: Annotated[float, Meta(ge=0, le=1_000_000)] = 2000.0
    """Of each agent, to all topics together; the rest is dropped and counted. 0: no limit, and a flood of one can hold
    up the commands of others."""
    max_requests_per_s: Annotated[float, Meta(ge=0, le=1_000_000)] = 500.0
    """The same of all else that an agent sends to this robot or asks it."""
    max_command_age_s: Annotated[float, Meta(ge=0, le=3600)] = 1.0
    """A command that has waited longer than this on its way is not carried out, nor are those that waited with it. 0:
    all are."""
    max_timed_command_age_s: Annotated[float, Meta(ge=0, le=3600)] = 0.2
    """A command of a headset that tells when it made it (docs/protocol.md) is not carried out when it may be older:
    the way there and back counts. 0: of any age, but not repeated, and in order."""
    max_frame_bytes: Bytes = 32 * 1024 * 1024
    """A larger message to headsets is not sent, and they are told. Gateways and headsets have limits of their own, by
    which such a message can end a connection."""
    max_message_parts: Annotated[int, Meta(ge=1024, le=10_000_000)] = 1 << 15
    """Strings and structures in a command, a request, an answer or a goal of a headset, where this robot has to
    translate or read it. More is refused: it would hold up everything else. An array of numbers is one part."""
    audit_file: str | None = None
    """File for a record of who did what, in lines that hang on each other: `macs audit verify` finds what was changed
    (docs/audit.md). Programs may share one. Unset: none is kept."""
    audit_max_bytes: Annotated[int, Meta(ge=4096, le=4 * 1024**3)] = 16 * 1024 * 1024
    """A new file is begun when it has so much; the older one is called ``….000001`` and so on."""
    audit_files: Annotated[int, Meta(ge=1, le=100_000)] = 20
    """So many older files are kept."""
    mirror: list[MirrorRule] = []
    """Topics and services of other robots in this robot's ROS graph, each a ``[[robot.mirror]]`` table."""
    rules: list[TopicRule] = []
    """What holds for topics, services and actions by name, each a ``[[robot.rules]]`` table."""
    groups: dict[str, list[AgentPattern]] = {}
    """Who is believed to be in a group where rights name it: ``{9 = ["block/1"]}``. Agents choose their groups; so
    somebody has to answer for them, as the gateway of block 1 does with `GatewaySettings.groups`."""

    def _check(self) -> None:
        for group, patterns in self.groups.items():
            if not names_agents(f"group/{group}"):
                raise self._wrong(f"groups.{group}", "is no group: 1 to 255")
            for pattern in patterns:
                if pattern.startswith("group/") or not names_agents(pattern):
                    problem = f"{pattern!r} names no agents, as *, unity, unity/5, ros and block/1 do"
                    raise self._wrong(f"groups.{group}", problem)
        for field in ("stop_allow", "release_allow", "register_allow"):
            for number, pattern in enumerate(getattr(self, field)):
                if not names_agents(pattern) and (field, pattern) != ("release_allow", WHO_STOPPED):
                    problem = f"{pattern!r} names no agents, as *, unity, unity/5, operator/5, block/1 and group/3 do"
                    raise self._wrong(f"{field}[{number}]", problem)
                kind, _, group = pattern.partition("/")
                if kind == "group" and group not in self.groups:
                    problem = f"{pattern!r}: say in robot.groups whom this robot believes to be in group {group}"
                    raise self._wrong(f"{field}[{number}]", problem)
