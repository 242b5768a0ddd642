"""What the doctor saw, before anybody judges it. Pure; facts are written as JSON and read again in tests."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from macs_zenoh.protocol.ping import Pong

Reach = Literal["ok", "refused", "silent", "unknown_host", "unreachable", "untried"]
"""How an endpoint's host and port answer, below Zenoh; ``untried`` where there is no TCP to try (quic, udp)."""

Speaker = Literal["", "zenoh", "gateway", "other", "silent"]
"""Who is at a port, by its first bytes; empty: not tried."""

TlsProblem = Literal[
    "",
    "expired",
    "not_yet_valid",
    "unknown_ca",
    "wrong_name",
    "client_certificate_missing",
    "client_certificate_refused",
    "own_files",
    "no_tls",
    "failed",
]


class Certificate(msgspec.Struct, kw_only=True):
    """A certificate: whose, and until when (seconds since 1970)."""

    subject: str
    ends_s: float


class Tls(msgspec.Struct, kw_only=True):
    """How a TLS handshake with an endpoint went, and the router's certificate where it was accepted."""

    problem: TlsProblem = ""
    detail: str = ""
    certificate: Certificate | None = None


class Clock(msgspec.Struct, kw_only=True):
    """How far another clock is ahead of ours, and by how much that may be wrong: half of the way there and back."""

    offset_s: float
    within_s: float


class Echo(msgspec.Struct, kw_only=True):
    """So many bytes went there and came back in so many seconds."""

    size_bytes: int
    took_s: float


class NetworkPath(msgspec.Struct, kw_only=True):
    """The way to a router or a program."""

    round_trips_ms: list[float] = []
    echoes: list[Echo] = []
    lost_bytes: int = 0
    """Size of an echo that did not come back; 0: all did."""
    clock: Clock | None = None


class Rights(msgspec.Struct, kw_only=True):
    """What a session with these settings may do, by trying; None where trying shows nothing or was not done."""

    seen: bool | None = None
    """A presence token of one session is seen by another."""
    sees: bool | None = None
    """It sees anybody's presence or lease."""
    watches: bool | None = None
    """It is told of a presence token by subscription, too."""
    leases: bool | None = None
    """A lease of a block is seen by another session (gateways)."""
    hears: bool | None = None
    """What is sent to its own inbox arrives."""
    pings: bool | None = None
    """It may ping, and be pinged."""


class Session(msgspec.Struct, kw_only=True):
    """A session of a router, as its admin space has it."""

    zid: str
    whatami: str
    shared_memory: bool
    address: str


class RouterInfo(msgspec.Struct, kw_only=True):
    """A router, as its admin space describes it."""

    zid: str
    version: str
    sessions: list[Session] = []
    routers: list[str] = []
    """All routers that it is linked with, directly or through others, and itself."""


class Endpoint(msgspec.Struct, kw_only=True):
    """One router endpoint of the settings, as seen from here."""

    endpoint: str
    reach: Reach = "untried"
    reach_detail: str = ""
    tls: Tls | None = None
    """None where the endpoint is not tls."""
    speaks_tls: bool = False
    """A tcp endpoint without a Zenoh session that answers a TLS handshake."""
    speaker: Speaker = ""
    """Who answered at a tcp endpoint without a Zenoh session."""
    router_beside: str = ""
    """A router on the same host at the usual port, where the endpoint is a gateway's."""
    problem: str = ""
    """Why no Zenoh session opened, in Zenoh's words; empty when one did."""
    router: str = ""
    """Zenoh id of the router; empty without a session."""
    path: NetworkPath = msgspec.field(default_factory=NetworkPath)
    rights: Rights = msgspec.field(default_factory=Rights)
    drops_commands: bool | None = None
    """Where a link is full the router drops what has the priority of commands, also if it says that it waits."""
    routers: list[RouterInfo] = []
    """What the admin space shows from here; empty where it is off or hidden."""
    meets: list[str] = []
    """The other endpoints whose sessions see a token that was declared through this one."""
    presence: list[str] = []
    misses: list[str] = []
    """Presence keys that an endpoint shows which it meets, and this one does not, both asked twice."""
    leases: list[str] = []
    names: list[str] = []
    elsewhere: list[str] = []
    """Presence keys in other namespaces."""
    ros_nodes: list[str] = []
    """ROS nodes that run rmw_zenoh and whose sessions are in no namespace: as ``/robot1/talker``."""


class Program(msgspec.Struct, kw_only=True):
    """An agent or a gateway, by its Zenoh session."""

    zid: str
    agents: list[str]
    """As ros/7; a gateway's may be many."""
    blocks: list[int] = []
    pong: Pong | None = None
    path: NetworkPath = msgspec.field(default_factory=NetworkPath)
    called: bool | None = None
    """Whether it answered a call, where the settings' owner makes calls and it is a robot that serves them."""


class Own(msgspec.Struct, kw_only=True):
    """This machine and the settings that were examined."""

    macs: str = ""
    zenoh: str = ""
    python: str = ""
    who: str = ""
    """Whose rights were tried: ros/7, gateway/1; empty: nobody's in particular."""
    namespace: str = ""
    id_slots: int = 10
    group_slots: int = 10
    zenoh_settings: dict[str, Any] = {}
    """The lines of Zenoh's configuration that `analyze` judges, by path."""
    certificates: list[Certificate] = []
    """Our own and the CA's, where they can be read."""


class Facts(msgspec.Struct, kw_only=True):
    """Everything seen in one examination."""

    at_s: float
    """When, by this machine's clock, in seconds since 1970."""
    own: Own
    endpoints: list[Endpoint] = []
    programs: list[Program] = []
    unpinged: int = 0
    """Programs that were left out because there are many."""
    probe_bytes: int = 0
    """What the measurements put on the mesh, there and back."""
