"""The configuration, typed: what a settings file may say, its defaults, and the ranges that hold.

A settings file is TOML with up to five sections and a list of rules, one struct each below::

    [mesh]                                   # MeshSettings: every program on the mesh
    connect = ["tcp/192.168.1.10:7447"]

    [gateway]                                # GatewaySettings: `macs gateway`
    port = 7000

    [robot]                                  # RobotSettings: `macs agent`
    id = 7

    [awareness]                              # AwarenessSettings: `macs awareness`
    name = "drone0"

    [operator]                               # OperatorSettings: `macs ls`, `macs stop`, `macs doctor`
    id = 5

    [[traffic]]                              # TrafficRule: every program that sends
    match = "macs/from/ros/*/nd__camera$*"
    max_hz = 10

It is loaded once, in ``main``, and passed down. A misspelled name or a value out of range is a
`ConfigError` whose path names file and field. The ranges hold however a struct is made, because the
values end up in Zenoh, and Zenoh does not forgive (a transmit queue above 16 panics at the first link).
"""

from __future__ import annotations

import difflib
import ipaddress
import json
import os
import re
import sys
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar, get_args

import msgspec
from msgspec import Meta

from macs_zenoh.errors import ConfigError, UsageError
from macs_zenoh.protocol import addresses, endpoints
from macs_zenoh.protocol.keyexpr import expression_problem, type_name, type_number

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # type: ignore[import-not-found, unused-ignore]

Mode = Literal["client", "peer", "router"]

AgentId = Annotated[int, Meta(ge=1, le=0xFFFF)]
GroupId = Annotated[int, Meta(ge=0, le=0xFF)]
"""0 means: in no group."""
AgentName = Annotated[str, Meta(min_length=1, max_length=200)]
"""Any text: it is escaped where Zenoh or ROS would not take it."""
Port = Annotated[int, Meta(ge=0, le=0xFFFF)]
"""0 means: any free one."""
Millis = Annotated[int, Meta(ge=0, le=3_600_000)]
Seconds = Annotated[float, Meta(gt=0, le=86_400)]
Bytes = Annotated[int, Meta(ge=39, le=0xFFFF_FFFF)]
"""At least one header, at most what the header's u32 can declare."""

_NAME_PATTERN = r"^(/[A-Za-z0-9_*]+)+$"
_TOPIC_OR_NONE = r"^(/[A-Za-z_]\w*)*$"
NamePattern = Annotated[str, Meta(pattern=_NAME_PATTERN, max_length=256)]
"""A full ROS name in which ``*`` stands for anything within one level and ``**`` for any number of levels."""
Priority = Literal["real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background"]
"""Zenoh's priorities by the names that its configuration has for them, the highest first."""
AgentPattern = str
"""``*``, a type of agents, one of them (``unity/5``), a group (``group/3``) or a block of headsets (``block/1``)."""

ROUTER_RETRY_MS = 500
"""A router waits at least so long between attempts to reach another one: a link between routers that is back within
100 ms of its loss may stay dead (seen with Zenoh 1.10.2): connected, but without tokens and data."""

LOCAL_ROUTER = "tcp/127.0.0.1:7447"
EVERY_INTERFACE = "tcp/[::]:7447"

"""What an endpoint may begin with: the links that Zenoh has. Those over IP need a port."""


STREAM_PRIORITIES = ("data", "data_low", "background")
"""Of topic data, unless a rule says otherwise."""


class ZenohEntry(NamedTuple):
    """One line of Zenoh's own configuration.

    ``chosen`` tells a value that somebody asked for from our default: a default gives way to what a Zenoh
    configuration file (``config_file``) says about the same path.
    """

    path: str
    json5: str
    chosen: bool


class _Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A section of the settings file. Checks every range when it is made, from a file or in Python."""

    section: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for field in msgspec.structs.fields(self):
            try:
                msgspec.convert(getattr(self, field.name), field.type)
            except msgspec.ValidationError as error:
                raise self._wrong(field.name, _plain(str(error))[1]) from None
        self._check()

    def _check(self) -> None:
        """Rules that concern more than one field, or that a type cannot say."""

    def _wrong(self, field: str, problem: str) -> ConfigError:
        return ConfigError(f"{self.section}.{field}", problem)

    def _chosen(self, field: str) -> bool:
        """Whether the field differs from its default."""
        return bool(getattr(self, field) != getattr(type(self)(), field))


class MeshSettings(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a program joins the mesh. The comments name Zenoh's own paths and say why we differ from its defaults."""

    section: ClassVar[str] = "mesh"

    mode: Mode = "client"
    """Agents and gateways are clients: two peers on one router do not reach each other (Zenoh 1.10)."""
    connect: list[str] = []
    """Router endpoints, tried in order; several give fail-over. Empty: the local router, for a client."""
    listen: list[str] = []
    """Where to accept sessions. Empty: port 7447 on every interface for a router, nowhere for others."""
    config_file: str | None = None
    """Zenoh's own JSON5 file (``-c``). What it says wins over our defaults, not over fields that are set."""
    overrides: list[str] = []
    """``path:JSON5`` (``--cfg``), applied last, so they win over everything."""
    namespace: str | None = None
    """Zenoh's ``namespace``, put before every key: several meshes on one router."""

    lease_ms: Annotated[int, Meta(ge=500, le=600_000)] = 2000
    """How long a stopped host stays on the mesh after its last sign of life (Zenoh: 10 s)."""
    retry_min_ms: Annotated[int, Meta(ge=1, le=60_000)] = 50
    """First pause before another attempt to reach a router (Zenoh: 1 s, which is long for a teleoperator); between
    routers at least `ROUTER_RETRY_MS`."""
    retry_max_ms: Annotated[int, Meta(ge=1, le=60_000)] = 200
    """Longest such pause; each is twice the one before."""
    open_limit_ms: Annotated[int, Meta(ge=100, le=60_000)] = 3000
    """How long reaching one router may take before the next one's turn (Zenoh: 10 s). It is what a switched-off host
    costs, which refuses nothing; TCP, TLS and Zenoh's greeting need four round trips."""
    block_limit_ms: Annotated[int, Meta(ge=1, le=60_000)] = 500
    """How long a blocking put may wait for a stuck link before that link is closed (Zenoh: 5 s for everyone)."""
    drop_wait_ms: Millis = 20
    """How long a droppable message waits for room before it is dropped. Zenoh waits 1 ms, which loses messages on a
    machine that is merely busy; while a link stays full, only the first waits."""
    fragment_wait_ms: Millis = 50
    """The same for a message of several fragments, for all of them together: without it, big messages vanish."""
    tx_queue_batches: Annotated[int, Meta(ge=1, le=16)] = 8
    """Batches of 64 KiB queued per priority and link (Zenoh: 2). Above 16 Zenoh panics at the first link."""
    stream_queue_batches: Annotated[int, Meta(ge=1, le=16)] = 8
    """The same for topic data. On a slow link fewer: eight hold up what comes last by 0.2 s at 20 Mbit/s."""
    shared_memory: bool = False
    """Implicit shared memory bypasses size limits and can drop silently, so it is off (Zenoh: on)."""
    multicast: bool = False
    """Find routers by multicast scouting. Off: a mesh is what its endpoints say (Zenoh: on)."""
    id_slots: Annotated[int, Meta(ge=1, le=255)] = 10
    """Destination id slots in the frame header. The same on the whole mesh; 10 is what existing programs use."""
    group_slots: Annotated[int, Meta(ge=1, le=255)] = 10
    """Destination group slots in the frame header, likewise."""

    def _check(self) -> None:
        for field in ("connect", "listen"):
            for endpoint in getattr(self, field):
                problem = endpoints.problem(endpoint, lowest_port=0 if field == "listen" else 1)
                if problem:
                    raise self._wrong(field, f"{endpoint!r} {problem}")
        for override in self.overrides:
            if not re.match(r"[^:\s]+:.", override):
                raise self._wrong("overrides", f"{override!r} is not PATH:JSON5, as in mode:'\"peer\"'")
        if self.retry_min_ms > self.retry_max_ms:
            raise self._wrong("retry_min_ms", f"{self.retry_min_ms} is above retry_max_ms, {self.retry_max_ms}")
        if self.namespace is not None and not re.fullmatch(r"[^/*$?#\s]+(/[^/*$?#\s]+)*", self.namespace):
            raise self._wrong("namespace", f"{self.namespace!r} is not a plain key, as in site1 or site1/hall2")

    @property
    def routers(self) -> list[str]:
        """Endpoints to connect to: those given, else the local router for a client that names none."""
        if self.connect or self.mode != "client" or self.config_file or self.multicast:
            return self.connect
        return [LOCAL_ROUTER]

    def zenoh(self) -> list[ZenohEntry]:
        """These settings as Zenoh's configuration, without `config_file` and `overrides`, in the order to apply."""
        return [
            ZenohEntry(path, json.dumps(value), any(self._chosen(field) for field in fields))
            for path, value, fields in self._zenoh_table()
        ]

    def _zenoh_table(self) -> list[tuple[str, Any, tuple[str, ...]]]:
        """Rows of (Zenoh's path, value, the fields here that decide it)."""
        listen = self.listen or ([EVERY_INTERFACE] if self.mode == "router" else [])
        pauses = (self.retry_min_ms, self.retry_max_ms)
        if self.mode == "router":
            pauses = (max(pauses[0], ROUTER_RETRY_MS), max(pauses[1], ROUTER_RETRY_MS))
        retry = {"period_init_ms": pauses[0], "period_max_ms": pauses[1], "period_increase_factor": 2}
        queues = "transport/link/tx/queue"
        return [
            ("mode", self.mode, ("mode",)),
            ("connect/endpoints", self.routers, ("connect",)),
            # A client without these gives up on its first router instead of waiting for it.
            ("connect/timeout_ms", -1, ()),
            ("connect/exit_on_failure", False, ()),
            ("connect/retry", retry, ("retry_min_ms", "retry_max_ms")),
            ("listen/endpoints", listen, ("listen",)),
            ("scouting/multicast/enabled", self.multicast, ("multicast",)),
            # A router waits half a second for what it might discover: without scouting there is nothing.
            *([] if self.multicast else [("scouting/delay", 0, ())]),
            ("transport/unicast/open_timeout", self.open_limit_ms, ("open_limit_ms",)),
            ("transport/shared_memory/enabled", self.shared_memory, ("shared_memory",)),
            ("transport/link/tx/lease", self.lease_ms, ("lease_ms",)),
            (f"{queues}/congestion_control/drop/wait_before_drop", self.drop_wait_ms * 1000, ("drop_wait_ms",)),
            (
                f"{queues}/congestion_control/drop/max_wait_before_drop_fragments",
                self.fragment_wait_ms * 1000,
                ("fragment_wait_ms",),
            ),
            (f"{queues}/congestion_control/block/wait_before_close", self.block_limit_ms * 1000, ("block_limit_ms",)),
            *(
                (f"{queues}/size/{name}", getattr(self, field), (field,))
                for name in get_args(Priority)
                for field in ["stream_queue_batches" if name in STREAM_PRIORITIES else "tx_queue_batches"]
            ),
            # As zenohd has it: `macs doctor` reads versions, sessions and links between routers there.
            *([("adminspace/enabled", True, ())] if self.mode == "router" else []),
            *([("namespace", self.namespace, ("namespace",))] if self.namespace else []),
        ]


class GatewaySettings(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The TCP gateway: where headsets connect, and what one of them may cost."""

    section: ClassVar[str] = "gateway"

    host: str = "127.0.0.1"
    """Address to listen on. The protocol has no authentication, so the network is opened on purpose: 0.0.0.0, or ::
    for IPv6 as well. With or without brackets."""
    port: Port = 7000
    """TCP port to listen on. 0: any free one."""
    allow: list[str] = []
    """Networks whose addresses may connect, as in 192.168.1.0/24. Empty: everybody who reaches the port."""
    max_connections: Annotated[int, Meta(ge=1, le=65_535)] = 4096
    """Connections at one time, of all addresses together."""
    max_connections_per_address: Annotated[int, Meta(ge=1, le=65_535)] = 3072
    """One address never takes all. Lower it where headsets have addresses of their own; behind NAT they share one."""
    max_frame_bytes: Bytes = 32 * 1024 * 1024
    """A larger declared frame closes its connection before a byte of it is stored."""
    max_frames_per_s: Annotated[float, Meta(ge=0, le=1_000_000)] = 0.0
    """Frames of every kind from one connection; the rest is dropped and counted. 0: no limit."""
    max_commands_per_s: Annotated[float, Meta(ge=0, le=1_000_000)] = 2000.0
    """Of these, commands to robots; as a robot's own limit, before they fill the way to it. Stops are not counted."""
    max_requests_per_s: Annotated[float, Meta(ge=0, le=1_000_000)] = 2000.0
    """And all else that goes to robots."""
    handshake_timeout_s: Seconds = 10.0
    """A connection that has not configured itself by then is closed."""
    idle_timeout_s: Seconds = 60.0
    """A connection silent for so long is closed. Agents send a heartbeat after 5 s without other output; but a headset
    that is taken off for a moment sends none, and existing ones never connect again. Hosts that died are noticed by
    TCP, within 20 s."""
    outbox_bytes: Annotated[int, Meta(ge=64 * 1024, le=4 * 1024**3)] = 8 * 1024 * 1024
    """Waiting for one connection, at most. One message may always wait, however large."""
    write_timeout_s: Seconds = 30.0
    """A connection that takes nothing for so long while something waits is closed."""
    block: GroupId | None = None
    """The block of 256 agent ids this gateway gives out first, 0 being 1..255; unset: lease the first free one."""
    blocks: list[GroupId] = []
    """The only blocks it may lease: where routers hold its certificate to them (docs/security.md). Empty: any."""
    managers: list[str] = []
    """Own management messages, as my_package.world_class_manager:WorldClassManager (docs/managers.md)."""
    tell_refusals: bool = True
    """Tell a headset when a robot refused its registration, by a management message that existing programs ignore."""
    groups: dict[str, list[str]] = {}
    """Groups that not everybody here may choose, and the networks whose agents may: ``{9 = ["10.0.3.0/24"]}``. Who may
    not is in no group. For robots that give rights to a group (`RobotSettings.groups`). Other groups are free."""
    robots: list[AgentId] | Literal["any"] = []
    """Ids that agents who are no headsets may have here: existing robot programs. They get one of these, headsets do
    not. Without it none may come, because whoever reaches the port could be a robot that is away just now. ``any``:
    whatever id is free, as with the old router; for meshes on which no robot has a session of its own."""
    robot_packages: list[str] = []
    """Packages of ROS types that existing robot programs here have, besides the common ones and those of the topics
    and services that they name. A type of another package ends such a program's thread, so it is refused."""
    reuse_port: bool = False
    """Share the port with other gateway processes (SO_REUSEPORT); set by ``--workers``."""

    def _check(self) -> None:
        try:
            msgspec.structs.force_setattr(self, "host", addresses.bare(self.host))
        except ValueError as error:
            raise self._wrong("host", str(error)) from None
        for group in self.groups:
            if not _names_agents(f"group/{group}"):
                raise self._wrong(f"groups.{group}", "is no group: 1 to 255")
        for where, networks in [("allow", self.allow), *((f"groups.{g}", of) for g, of in self.groups.items())]:
            for network in networks:
                try:
                    ipaddress.ip_network(network, strict=False)
                except ValueError as error:
                    raise self._wrong(where, f"{network!r} is not a network, as in 192.168.1.0/24: {error}") from None


class TopicRule(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
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


class RobotSettings(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
    stop_topic: Annotated[str, Meta(pattern=_TOPIC_OR_NONE)] = "/emergency_stop"
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
    max_frame_bytes: Bytes = 32 * 1024 * 1024
    """A larger message to headsets is not sent, and they are told. Gateways and headsets have limits of their own, by
    which such a message can end a connection."""
    rules: list[TopicRule] = []
    """What holds for topics, services and actions by name, each a ``[[robot.rules]]`` table."""
    groups: dict[str, list[AgentPattern]] = {}
    """Who is believed to be in a group where rights name it: ``{9 = ["block/1"]}``. Agents choose their groups; so
    somebody has to answer for them, as the gateway of block 1 does with `GatewaySettings.groups`."""

    def _check(self) -> None:
        for group, patterns in self.groups.items():
            if not _names_agents(f"group/{group}"):
                raise self._wrong(f"groups.{group}", "is no group: 1 to 255")
            for pattern in patterns:
                if pattern.startswith("group/") or not _names_agents(pattern):
                    problem = f"{pattern!r} names no agents, as *, unity, unity/5, ros and block/1 do"
                    raise self._wrong(f"groups.{group}", problem)
        for field in ("stop_allow", "release_allow", "register_allow"):
            for number, pattern in enumerate(getattr(self, field)):
                if not _names_agents(pattern) and (field, pattern) != ("release_allow", WHO_STOPPED):
                    problem = f"{pattern!r} names no agents, as *, unity, unity/5, operator/5, block/1 and group/3 do"
                    raise self._wrong(f"{field}[{number}]", problem)
                kind, _, group = pattern.partition("/")
                if kind == "group" and group not in self.groups:
                    problem = f"{pattern!r}: say in robot.groups whom this robot believes to be in group {group}"
                    raise self._wrong(f"{field}[{number}]", problem)


def _names_agents(pattern: str) -> bool:
    """Whether some agent can fit: others are typing errors, which would lock somebody out without a word."""
    kind, slash, number = pattern.partition("/")
    ranges = {"group": (1, 255), "block": (0, 255)}
    if kind not in ranges:
        try:
            known = kind == type_name(type_number(kind))  # 1 is always written ros
        except UsageError:
            known = False
        if not slash or not known:
            return pattern == "*" or known
    low, high = ranges.get(kind, (0, 0xFFFF))
    return number.isascii() and number.isdigit() and str(int(number)) == number and low <= int(number) <= high


class AwarenessSettings(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Collective awareness: what this robot is called among robots, and how its messages to them travel."""

    section: ClassVar[str] = "awareness"

    name: AgentName = "drone0"
    """What others send to. It must be the only one of this name on the mesh."""
    transport: Literal["mesh", "topic", "both"] = "mesh"
    """``topic`` is the plain ROS topic that existing as2_ca gateways share within one domain."""
    id: AgentId | None = None
    """This robot's id on the mesh. Unset: lease a free one."""
    beside: bool = False
    """A robot agent with this ``id`` runs on this robot as well: the name becomes its name, and no id is taken."""
    max_bytes: Bytes = 32 * 1024 * 1024
    """A larger message is refused where it is sent."""
    max_hz: dict[str, Annotated[float, Meta(gt=0)]] = {}
    """Per message type: what is sent more often is dropped and counted."""
    deadlines_s: dict[str, Seconds] = {}
    """Per message type: how long a message to one robot may wait for it, and is repeated until it is confirmed."""
    last_values: list[str] = []
    """Message types of which every other robot's last message to all is asked for when this one joins."""
    cache: dict[str, Annotated[int, Meta(ge=1, le=100_000)]] = {}
    """Per message type: keep the last so many messages to all, for robots that miss some while the mesh is interrupted
    (docs/reliable.md)."""
    only_addressed: bool = True
    """Take only what is for this robot or for all. Off: also what the plain topic carries for others."""
    drop_own: bool = True
    """Off: what this robot sends to all on the plain topic is delivered to its own modules as well."""

    def _check(self) -> None:
        if self.beside and self.id is None:
            raise self._wrong("beside", "needs the id of the robot agent")


class OperatorSettings(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Who asks robots and stops them from a command line."""

    section: ClassVar[str] = "operator"

    id: AgentId | None = None
    """Makes it ``operator/5``, for robots and access rules that want to know (``--as`` wins). Unset: ``operator/0``,
    who is nobody in particular."""


class TrafficRule(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What holds for messages whose key fits an expression; one ``[[traffic]]`` table. See docs/traffic.md.

    Of several rules that fit a key, each setting comes from the first one that gives it. A rule holds where a message
    enters the mesh: in the gateway for what its headsets send, in the robot agent for its topics.
    """

    section: ClassVar[str] = "traffic"

    match: str
    """A Zenoh key expression: ``*`` is one chunk, ``**`` any number, ``$*`` a part of one, as in
    ``macs/from/ros/*/nd__camera$*``. Without the mesh's namespace."""

    max_hz: Annotated[float, Meta(gt=0, le=1_000_000)] | None = None
    """So many messages per second for each key; the rest is dropped."""
    max_bytes: Annotated[int, Meta(ge=1, le=0xFFFF_FFFF)] | None = None
    """A larger message is dropped, a larger call refused. Counted with its header, as it is on the mesh."""
    max_bytes_per_s: Annotated[int, Meta(ge=1, le=1_000_000_000_000)] | None = None
    """So many bytes per second for all keys of this rule together, as far as this program sends them."""
    priority: Priority | None = None
    """Instead of that of its class (commands ``real_time``, calls ``interactive_high``, topic data ``data``)."""
    cache: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    """The source keeps so many messages of each key; receivers ask for those that they missed."""

    def _check(self) -> None:
        problem = expression_problem(self.match)
        if problem is not None:
            raise self._wrong("match", f"{self.match!r} is not a key expression: {problem}")


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole settings file."""

    mesh: MeshSettings = MeshSettings()
    gateway: GatewaySettings = GatewaySettings()
    robot: RobotSettings = RobotSettings()
    awareness: AwarenessSettings = AwarenessSettings()
    operator: OperatorSettings = OperatorSettings()
    traffic: list[TrafficRule] = []


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a file that somebody wrote for us. Raises `ConfigError`: it cannot be read, or is not UTF-8."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(str(path), error.strerror or str(error)) from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), f"not UTF-8 at byte {error.start}") from error


def load(*paths: str | os.PathLike[str]) -> Settings:
    """Read settings files (TOML); of several, a later one wins, setting by setting.

    Raises `ConfigError`: one cannot be read, is not TOML, has an unknown name or a value out of range.
    """
    document: dict[str, Any] = {}
    settings = Settings()
    for path in paths:
        source = str(path)
        for name, section in _document(read_text(path), source).items():
            before = document.get(name)
            if isinstance(before, dict) and isinstance(section, dict):
                section = {**before, **section}
            document[name] = section
        settings = _settings(document, source)
    return settings


def parse(text: str, source: str = "settings") -> Settings:
    """Turn the text of a settings file into settings; ``source`` names it in errors."""
    return _settings(_document(text, source), source)


def _document(text: str, source: str) -> dict[str, Any]:
    try:
        document: dict[str, Any] = tomllib.loads(text)
        return document
    except RecursionError as error:
        raise ConfigError(source, "not TOML that anybody wrote: it nests too deep") from error
    except ValueError as error:  # a TOMLDecodeError, or of a number or a date
        raise ConfigError(source, f"not TOML: {error}") from error


def _settings(document: dict[str, Any], source: str) -> Settings:
    try:
        return msgspec.convert(document, Settings)
    except msgspec.ValidationError as error:
        where, problem = _plain(str(error))
        raise ConfigError(f"{source}: {where}" if where else source, problem + _hint(where, problem)) from None
    except ConfigError as error:
        raise ConfigError(f"{source}: {error.path}", error.problem) from None


_S = TypeVar("_S", bound=msgspec.Struct)


def changed(settings: _S, **changes: Any) -> _S:
    """The same settings with some fields replaced; a change to None leaves the field (an option not given).

    Raises `ConfigError` naming section and field.
    """
    return msgspec.structs.replace(settings, **{name: value for name, value in changes.items() if value is not None})


_IN_WORDS = {
    _NAME_PATTERN: "a full name that begins with /, as /camera/image, /camera/* or /camera/**",
    _TOPIC_OR_NONE: "the full name of a topic, which begins with /, or nothing",
}
"""What msgspec would show as a regular expression."""


def _plain(text: str) -> tuple[str, str]:
    """Split msgspec's ``Expected `int` <= 9 - at `$.mesh.port``` into a dotted path and a sentence."""
    problem, _, where = text.partition(" - at `$")
    problem = problem.replace("Object contains unknown field", "unknown name").replace("array", "list")
    for pattern, words in _IN_WORDS.items():
        problem = problem.replace(f"`str` matching regex {pattern!r}", words)
    return where.rstrip("`").lstrip("."), problem[:1].lower() + problem[1:]


def _hint(where: str, problem: str) -> str:
    """``, did you mean `port`?`` after an unknown name that is nearly a known one."""
    unknown = re.fullmatch(r"unknown name `(.+)`", problem)
    sections: dict[str, Any] = {
        kind.section: kind
        for kind in (
            *(MeshSettings, GatewaySettings, RobotSettings, AwarenessSettings, OperatorSettings),
            *(TopicRule, TrafficRule),
        )
    }
    owner = sections.get(re.sub(r"\[\d+\]$", "", where), Settings)
    if unknown is None:
        return ""
    near = difflib.get_close_matches(unknown[1], [field.name for field in msgspec.structs.fields(owner)], n=1)
    return f", did you mean `{near[0]}`?" if near else ""
