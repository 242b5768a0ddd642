"""What a settings file may say of `macs gateway`. Pure."""

from __future__ import annotations

import ipaddress
from typing import Annotated, ClassVar, Literal

import msgspec
from msgspec import Meta

from macs_zenoh.protocol import addresses
from macs_zenoh.sections import AgentId, Bytes, GroupId, Port, Seconds, Section

from .agents import names_agents

WithoutToken = Literal["nobody", "everybody"] | list[str]
"""Networks are named as in 192.168.1.0/24."""


class GatewaySettings(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The TCP gateway: where headsets connect, and what one of them may cost."""

    section: ClassVar[str] = "gateway"

    host: str = "127.0.0.1"
    """Address to listen on. Existing programs have no password, so the network is opened on purpose: 0.0.0.0, or ::
    for IPv6 as well. With or without brackets."""
    port: Port = 7000
    """TCP port to listen on. 0: any free one."""
    tls_port: Port | None = None
    """TCP port for the same over TLS, with `certificate` and `key`. 0: any free one. Unset: none."""
    web_port: Port | None = None
    """Port for HTTP and WebSocket, with the extra ``web``; over TLS when there is a `certificate`, unless ``web_host``
    is this machine alone. 0: any free one. Unset: none."""
    web_host: str | None = None
    """Address of the web port. Unset: as ``host``."""
    certificate: str | None = None
    """File (PEM) with the certificate that the TLS port and the web port show, and those that it hangs on."""
    key: str | None = None
    """File (PEM) with its key."""
    web_origins: list[str] = []
    """Origins of web pages that may connect besides the gateway's own, as in https://hall.example.org."""
    web_names: list[str] = []
    """Names of this gateway, as in hall.example.org, by which browsers may call its web port besides by address."""
    tokens_file: str | None = None
    """File of tokens that `macs token` keeps. Unset: ``$MACS_TOKENS``, else ~/.config/macs/tokens.json."""
    plain_without_token: WithoutToken = "everybody"  # noqa: S105 - no password
    """Who may come to ``port`` without a token: nobody, everybody, or the networks named. A token that is shown counts
    in any case, and must be valid."""
    tls_without_token: WithoutToken | None = None
    """The same for ``tls_port``. Unset: nobody, or everybody where that is this machine alone."""
    web_without_token: WithoutToken | None = None
    """The same for ``web_port``."""
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
    """Of these, commands to robots; as a robot's own limit, before they fill the way to it. Stops are not counted, and
    each 16 KiB of what is larger."""
    max_requests_per_s: Annotated[float, Meta(ge=0, le=1_000_000)] = 2000.0
    """And all else that goes to robots. All who send much have four times as much together."""
    handshake_timeout_s: Seconds = 10.0
    """A connection that has not configured itself by then is closed."""
    idle_timeout_s: Seconds = 60.0
    """A connection silent for so long is closed. Agents send a heartbeat after 5 s without other output; but a headset
    that is taken off for a moment sends none, and existing ones never connect again. Hosts that died are noticed by
    TCP, within 20 s."""
    resume_s: Annotated[float, Meta(ge=0, le=600)] = 30.0
    """So long after its connection has ended a headset that asks for it can come back, by any port of the gateway, as
    the same one: with its id, group, registrations, and what waited for it. Others hear nothing of it, but robots stop
    what it was moving. 0: it leaves at once."""
    outbox_bytes: Annotated[int, Meta(ge=64 * 1024, le=4 * 1024**3)] = 8 * 1024 * 1024
    """Waiting for one connection, at most. One message may always wait, however large."""
    write_timeout_s: Seconds = 30.0
    """A connection that takes nothing for so long while something waits is closed."""
    block: GroupId | None = None
    """The block of 256 agent ids this gateway gives out first, 0 being 1..255; unset: lease the first free one."""
    blocks: list[GroupId] = []
    """The only blocks it may lease: where routers hold its certificate to them (docs/security.md). Empty: any. One
    address never has more than three quarters of their ids."""
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
    audit_file: str | None = None
    """File for a record of who did what, in lines that hang on each other: `macs audit verify` finds what was changed
    (docs/audit.md). Programs may share one. Unset: none is kept."""
    audit_max_bytes: Annotated[int, Meta(ge=4096, le=4 * 1024**3)] = 16 * 1024 * 1024
    """A new file is begun when it has so much; the older one is called ``….000001`` and so on."""
    audit_files: Annotated[int, Meta(ge=1, le=100_000)] = 20
    """So many older files are kept."""
    recordings: str | None = None
    """Folder of a recorder on this machine (``macs record --serve``): whoever has the right to ``record`` finds it on
    the web port's page. Unset: none."""
    reuse_port: bool = False
    """Share the port with other gateway processes (SO_REUSEPORT); set by ``--workers``."""

    def _check(self) -> None:
        try:
            msgspec.structs.force_setattr(self, "host", addresses.bare(self.host))
        except ValueError as error:
            raise self._wrong("host", str(error)) from None
        try:
            if self.web_host is not None:
                msgspec.structs.force_setattr(self, "web_host", addresses.bare(self.web_host))
        except ValueError as error:
            raise self._wrong("web_host", str(error)) from None
        if (self.certificate is None) != (self.key is None):
            raise self._wrong("certificate", "needs a key, and a key needs a certificate")
        if self.tls_port is not None and self.certificate is None:
            raise self._wrong("tls_port", "needs a certificate and its key")
        for group in self.groups:
            if not names_agents(f"group/{group}"):
                raise self._wrong(f"groups.{group}", "is no group: 1 to 255")
        lists = [("allow", self.allow), *((f"groups.{g}", of) for g, of in self.groups.items())]
        for field in ("plain_without_token", "tls_without_token", "web_without_token"):
            lists += [(field, of)] if isinstance(of := getattr(self, field), list) else []
        for where, networks in lists:
            for network in networks:
                try:
                    ipaddress.ip_network(network, strict=False)
                except ValueError as error:
                    raise self._wrong(where, f"{network!r} is not a network, as in 192.168.1.0/24: {error}") from None
