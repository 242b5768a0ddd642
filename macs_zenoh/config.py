"""What the library has settings for: how a program joins the mesh, and what it may send there. Pure.

What our programs have besides is in `bridge.settings`, which reads whole settings files; what holds for every section
is in `sections`.
"""

from __future__ import annotations

import json
import re
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args

from msgspec import Meta

from .protocol import endpoints
from .protocol.key_expressions import expression_problem
from .sections import Millis, Section

Mode = Literal["client", "peer", "router"]
Priority = Literal["real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background"]
"""Zenoh's priorities by the names that its configuration has for them, the highest first."""

ROUTER_RETRY_MS = 500
"""A router waits at least so long between attempts to reach another one: a link between routers that is back within
100 ms of its loss may stay dead (seen with Zenoh 1.10.2): connected, but without tokens and data."""

LOCAL_ROUTER = "tcp/127.0.0.1:7447"
EVERY_INTERFACE = "tcp/[::]:7447"

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


NEVER_BLOCKS: dict[str, Any] = {
    "id": "commands wait for nobody",
    "messages": ["put"],
    "flows": ["ingress"],
    "qos": {"priority": "real_time"},
    "key_exprs": ["**/macs/**"],
    "overwrite": {"congestion_control": "drop"},
}
"""What a router makes of puts with the priority of commands: where a link is full they are dropped.

Ours say so themselves. A blocking put of somebody else keeps the lock of its queue while it waits, so everybody's
commands to that robot wait behind it, and with them the threads that read their links: a router of Zenoh 1.10.2 has
two. Then a stop is not even read."""


class MeshSettings(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
    trace_every: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    """One in so many of a robot's topic messages is traced always, as by `macs trace`; a gateway with it notes those
    that come. 0: only what somebody asks for."""

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
            *([("qos/network", [NEVER_BLOCKS], ())] if self.mode == "router" else []),
            # As zenohd has it: `macs doctor` reads versions, sessions and links between routers there.
            *([("adminspace/enabled", True, ())] if self.mode == "router" else []),
            *([("namespace", self.namespace, ("namespace",))] if self.namespace else []),
        ]


class TrafficRule(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
