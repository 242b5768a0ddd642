"""The policy: who exists on a mesh, and who may command, see, call or message whom. Pure, except `load`.

One YAML file, from which `macs security generate` makes certificates, routers' rules and settings files::

    routers:
      - {name: site, addresses: [site.example.org]}
    robots:
      - {name: robot-7, id: 7, group: 3, awareness_name: drone7}
    gateways:
      - {name: hall, blocks: [1]}
    operators:
      - {name: anna}
    permissions:
      - {who: all, may: all, whom: all}

What no permission says is denied.
"""

from __future__ import annotations

import difflib
import ipaddress
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from bridge.settings import GatewaySettings
from macs_zenoh.config import MeshSettings, TrafficRule
from macs_zenoh.errors import ConfigError, MissingExtra
from macs_zenoh.protocol import endpoints
from macs_zenoh.protocol.name_patterns import NamePattern
from macs_zenoh.protocol.rights import Right as HeadsetRight
from macs_zenoh.sections import AgentId, AgentName, GroupId, read, read_text

Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=63)]
"""Also the name in the certificate and of a directory, so: letters, digits, dot, dash and underscore."""
Names = str | list[str]
"""One name or several: of nodes, or ``robots``, ``gateways``, ``operators``, ``all``."""

Right = Literal["command", "see", "call", "message"]
RIGHTS: tuple[Right, ...] = ("command", "see", "call", "message")

KINDS = ("robots", "gateways", "operators")
ALL = "all"
RESERVED = {*KINDS, "routers", ALL, "ca"}

RESERVED_KEYS = ("macs",)
"""What the mesh's own keys begin with."""

PORT = 7447

LOOK_VERBS = ("offers", "definitions", "status", "trace")
"""Calls that only ask: what there is, how the robot is, and where the time of its messages goes."""
SEE_VERBS = ("add_node", "remove_node", *LOOK_VERBS)
"""Calls that go with seeing a robot: these, and to register for a topic."""
COMMAND_VERBS = (*SEE_VERBS, "control", "stop")
"""Calls that go with commanding it."""


class _Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One entry of a policy."""


class Router(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A zenohd or a ``macs router``."""

    name: Name
    addresses: Annotated[list[str], Meta(min_length=1)]
    """Host names and IP addresses by which it is reached. They are in its certificate, and no other is accepted."""
    listen: Annotated[list[str], Meta(min_length=1)] = msgspec.field(default_factory=lambda: [f"tls/[::]:{PORT}"])
    endpoints: list[str] = []
    """Where others dial it. Empty: the first address, at the port of the first ``listen``."""
    links: list[str] = []
    """Routers that this one dials. Between two, one is enough: the one that can reach the other."""

    @property
    def dialled(self) -> list[str]:
        """Its endpoints for others."""
        if self.endpoints:
            return self.endpoints
        listening = endpoints.address_of(self.listen[0])
        protocol, port = endpoints.protocol_of(self.listen[0]), listening.port if listening else PORT
        return [endpoints.written(protocol, self.addresses[0], port)]


class _Client(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Who dials routers."""

    name: Name
    routers: list[str] = []
    """Which, in the order in which they are tried. Empty: all, in the order of the policy."""


class Robot(_Client, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot agent."""

    id: AgentId
    group: GroupId = 0
    """0: in no group."""
    awareness_name: AgentName | None = None
    """Its name in collective awareness; without one it takes no part in it."""
    ros_namespace: Annotated[str, Meta(pattern=r"^([A-Za-z0-9_-]+)?$", max_length=63)] = ""
    """The namespace of its ROS nodes' sessions, where they run rmw_zenoh: keys below it are this robot's alone."""


class Gateway(_Client, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A gateway, which speaks for the headsets that connect to it."""

    blocks: list[GroupId] = []
    """The blocks of 256 ids that it gives out, so that its certificate is good for these ids only. Empty: any."""
    groups: dict[str, list[str]] = {}
    """Groups that robots believe of its headsets, for rights, and the networks whose headsets may choose them."""
    ports: list[Annotated[str, Meta(pattern=r"^(tcp|tls|ws|wss)/.+:[0-9]{1,5}\Z")]] = []
    """Where headsets reach it, as in tls/10.0.0.5:7001: there `check` tries their tokens."""


class Operator(_Client, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A person with ``macs ls`` and ``macs doctor``, who sees who is there and how the routers are."""

    id: AgentId | None = None
    """With an id it is ``operator/5`` and nobody else, and its settings say so. Unset: ``operator/0``, who is nobody
    in particular, and whom nobody can write to."""


class Headset(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Who comes to gateways with a token: what it may there. What routers let those gateways do holds besides."""

    name: Name
    gateways: list[str] = []
    """Which. Empty: all."""
    may: list[HeadsetRight] = []
    robots: list[str] | Literal["any"] = []
    """By their names."""
    groups: list[Annotated[int, Meta(ge=1, le=0xFF)]] | Literal["any"] = []
    topics: list[NamePattern] = []
    """Patterns of topics, services and actions. Empty: every one."""
    frames_per_s: Annotated[float, Meta(ge=0, le=1_000_000)] = 0.0
    days: Annotated[int, Meta(ge=1, le=3650)] | None = None
    """How long a token holds; `generate` gives it as long again when less than a third is left. Unset: for ever."""


class Permission(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Who may do what to whom. Nobody gets a right over itself by it, and needs none."""

    who: Names
    may: Right | Literal["all"] | list[Right]
    whom: Names
    verbs: list[Annotated[str, Meta(min_length=1)]] = []
    """With ``call``: these verbs only. Empty: every one."""

    @property
    def rights(self) -> tuple[Right, ...]:
        """What it gives."""
        if self.may == "all":
            return RIGHTS
        return tuple(self.may) if isinstance(self.may, list) else (self.may,)


class Certificates(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How long certificates hold. They are renewed when less than a third of it is left."""

    days: Annotated[int, Meta(ge=1, le=3650)] = 90
    ca_days: Annotated[int, Meta(ge=1, le=36500)] = 3650


ELSEWHERE = ("mode", "connect", "listen", "config_file", "overrides", "namespace")
"""Fields of `MeshSettings` that follow from the rest of a policy, or hold for one program only."""


Node = Router | Robot | Gateway | Operator
Client = Robot | Gateway | Operator


class Policy(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole policy. Made by `load` or `parse`, which refuse what contradicts itself."""

    routers: Annotated[list[Router], Meta(min_length=1)]
    robots: list[Robot] = []
    gateways: list[Gateway] = []
    operators: list[Operator] = []
    headsets: list[Headset] = []
    permissions: list[Permission] = []
    traffic: list[TrafficRule] = []
    """As in a settings file: each program and each router applies them."""
    namespace: str | None = None
    """Zenoh's, before every key."""
    mesh: MeshSettings = MeshSettings()
    """What leaves the defaults on every link: a link needs the same at both ends. As in a settings file, without what
    the policy has words of its own for (`ELSEWHERE`)."""
    certificates: Certificates = Certificates()

    @property
    def clients(self) -> list[Client]:
        """Everybody who dials routers."""
        return [*self.robots, *self.gateways, *self.operators]

    @property
    def nodes(self) -> list[Node]:
        """Everybody who has a certificate."""
        return [*self.routers, *self.clients]

    def node(self, name: str) -> Node:
        """The node of this name. Raises ConfigError."""
        for node in self.nodes:
            if node.name == name:
                return node
        raise ConfigError("policy", _unknown(name, [node.name for node in self.nodes]))

    def endpoints(self, client: Client) -> list[str]:
        """Where a client dials, the first one first."""
        routers = {router.name: router for router in self.routers}
        names = client.routers or list(routers)
        return [endpoint for name in names for endpoint in routers[name].dialled]

    # -- permissions ---------------------------------------------------------------------------------------------

    def may(self, who: Client, right: Right, whom: Client) -> bool:
        """Whether a permission says so."""
        return any(right in permission.rights for permission in self._between(who, whom))

    def verbs(self, who: Client, whom: Client) -> list[str] | None:
        """The verbs that one may call of another, in the order of the policy; None: every one."""
        found: dict[str, None] = {}
        for permission in self._between(who, whom):
            if "call" in permission.rights:
                if not permission.verbs:
                    return None
                found.update(dict.fromkeys(permission.verbs))
            if isinstance(whom, Robot):
                if "command" in permission.rights:
                    found.update(dict.fromkeys(COMMAND_VERBS))
                if "see" in permission.rights:
                    found.update(dict.fromkeys(SEE_VERBS))
        return list(found)

    def related(self, one: Client, other: Client) -> bool:
        """Whether one of the two may do anything to the other."""
        return any(True for _ in self._between(one, other)) or any(True for _ in self._between(other, one))

    def same(self, one: Client, other: Client, to: Client) -> bool:
        """Whether the same is permitted between both and a third."""
        return self._all_rights(one, to) == self._all_rights(other, to)

    def _all_rights(self, one: Client, other: Client) -> tuple[object, ...]:
        ways = ((one, other), (other, one))
        return tuple((self.verbs(a, b), *(self.may(a, right, b) for right in RIGHTS)) for a, b in ways)

    def _between(self, who: Client, whom: Client) -> Iterator[Permission]:
        if who is whom or who.name == whom.name:
            return
        for permission in self.permissions:
            if self._covers(permission.who, who) and self._covers(permission.whom, whom):
                yield permission

    @staticmethod
    def _covers(names: Names, node: Client) -> bool:
        return any(name in (ALL, kind_of(node), node.name) for name in _listed(names))


def kind_of(node: Node) -> str:
    """``robots``, ``gateways``, ``operators`` or ``routers``: the policy's list that it is in."""
    return type(node).__name__.lower() + "s"


# -- reading -----------------------------------------------------------------------------------------------------


def load(path: str | os.PathLike[str]) -> Policy:
    """Read a policy. Raises `ConfigError`: it cannot be read, is not YAML, or says what cannot be."""
    return parse(read_text(path), str(path))


def parse(text: str, source: str = "policy") -> Policy:
    """Turn the text of a policy into a policy; ``source`` names it in errors."""
    document = _yaml(text, source)
    if not isinstance(document, dict):
        raise ConfigError(source, "a policy has routers, robots, gateways, operators and permissions")
    policy = read(document, Policy, source)
    try:
        _check(policy)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error.path}", error.problem) from None
    return policy


def _yaml(text: str, source: str) -> Any:
    try:
        import yaml
    except ImportError:
        raise MissingExtra("reading a policy", "PyYAML", "security") from None

    class Loader(yaml.SafeLoader):  # type: ignore[misc, unused-ignore]
        """YAML, in which one name twice in a mapping is a mistake, not a replacement."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            seen = set()
            for key, _ in node.value:
                if not isinstance(key, yaml.ScalarNode):
                    raise yaml.constructor.ConstructorError(None, None, "a list as a name", key.start_mark)
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} twice", key.start_mark)
                seen.add(key.value)
            return super().construct_mapping(node, deep)

    try:
        return yaml.load(text, Loader)  # noqa: S506 - a safe loader
    except yaml.MarkedYAMLError as error:
        line = f": line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"{source}{line}", f"not YAML: {error.problem}") from error
    except yaml.YAMLError as error:
        raise ConfigError(source, f"not YAML: {error}") from error
    except RecursionError as error:
        raise ConfigError(source, "not YAML that anybody wrote: it nests too deep") from error
    except (ValueError, TypeError, OverflowError) as error:  # of a date, or a number
        raise ConfigError(source, f"not YAML: {error}") from error


# -- what contradicts itself -------------------------------------------------------------------------------------

_T = TypeVar("_T")


def _check(policy: Policy) -> None:
    names = [node.name for node in policy.nodes]
    _once("name", ((f"{kind_of(node)}: {node.name}", node.name.lower()) for node in policy.nodes))
    for name in names:
        if name in RESERVED:
            raise ConfigError(name, "is a word of the policy; choose another name")
    _once("id", ((f"robots: {robot.name}", robot.id) for robot in policy.robots))
    _once("id", ((f"operators: {o.name}", o.id) for o in policy.operators if o.id is not None))
    _once(
        "awareness_name",
        (
            (f"robots: {robot.name}", robot.awareness_name)
            for robot in policy.robots
            if robot.awareness_name is not None
        ),
    )
    with_nodes = [robot for robot in policy.robots if robot.ros_namespace]
    _once("ros_namespace", ((f"robots: {robot.name}", robot.ros_namespace) for robot in with_nodes))
    for robot in with_nodes:
        if robot.ros_namespace in (*RESERVED_KEYS, policy.namespace):
            raise ConfigError(f"robots: {robot.name}.ros_namespace", f"{robot.ros_namespace} is the mesh's own")
    _once("block", ((f"gateways: {gateway.name}", block) for gateway in policy.gateways for block in gateway.blocks))
    for router in policy.routers:
        _check_router(router, policy)
    for client in policy.clients:
        _known(f"{client.name}.routers", client.routers, [router.name for router in policy.routers])
    for gateway in policy.gateways:
        try:
            GatewaySettings(groups=gateway.groups)
        except ConfigError as error:
            field = error.path.rpartition("gateway.")[2]
            raise ConfigError(f"gateways: {gateway.name}.{field}", error.problem) from None
    _check_headsets(policy)
    for number, permission in enumerate(policy.permissions):
        _check_permission(f"permissions[{number}]", permission, policy)
    for field in ELSEWHERE:
        if getattr(policy.mesh, field) != getattr(MeshSettings(), field):
            raise ConfigError(f"mesh.{field}", "is not for every link; a policy says it elsewhere")
    days, ca_days = policy.certificates.days, policy.certificates.ca_days
    if ca_days < days:
        raise ConfigError("certificates.ca_days", f"below days, {days}: the authority would end before what it signs")
    _check_crowd(policy)
    MeshSettings(namespace=policy.namespace)  # its rules for a namespace


def _check_router(router: Router, policy: Policy) -> None:
    where = f"routers: {router.name}"
    for field in ("listen", "endpoints"):
        for endpoint in getattr(router, field):
            wrong = endpoints.problem(endpoint, lowest_port=0 if field == "listen" else 1)
            if wrong or endpoints.protocol_of(endpoint) not in ("tls", "quic"):
                raise ConfigError(f"{where}.{field}", f"{endpoint!r} is no TLS endpoint, as in tls/10.0.0.5:7447")
    for address in router.addresses:
        if "/" in address or not (_is_ip(address) or re.fullmatch(r"[A-Za-z0-9.-]+", address)):
            raise ConfigError(f"{where}.addresses", f"{address!r} is no host name or IP address")
    _known(f"{where}.links", router.links, [other.name for other in policy.routers if other is not router])


def _check_headsets(policy: Policy) -> None:
    taken = {node.name.lower() for node in policy.nodes} | RESERVED
    _once("name", ((f"headsets: {headset.name}", headset.name.lower()) for headset in policy.headsets))
    for headset in policy.headsets:
        where = f"headsets: {headset.name}"
        if headset.name.lower() in taken:
            raise ConfigError(where, "is the name of a node, or a word of the policy; choose another")
        _known(f"{where}.gateways", headset.gateways, [gateway.name for gateway in policy.gateways])
        if not isinstance(headset.robots, str):
            _known(f"{where}.robots", headset.robots, [robot.name for robot in policy.robots])


def _check_permission(where: str, permission: Permission, policy: Policy) -> None:
    known = [*KINDS, ALL, *(client.name for client in policy.clients)]
    for field in ("who", "whom"):
        names = _listed(getattr(permission, field))
        if not names:
            raise ConfigError(f"{where}.{field}", "names nobody")
        _known(f"{where}.{field}", names, known)
    if not permission.rights:
        raise ConfigError(f"{where}.may", "gives no right")
    if permission.verbs and "call" not in permission.rights:
        raise ConfigError(f"{where}.verbs", "belong to `call`, which this permission does not give")


def _check_crowd(policy: Policy) -> None:
    """Headsets behind gateways without blocks cannot be told apart, so what holds for one gateway holds for all."""
    without = [gateway for gateway in policy.gateways if not gateway.blocks]
    if not without:
        return
    first = without[0]
    others = [client for client in policy.clients if not isinstance(client, Gateway)]
    for gateway in policy.gateways:
        differs = next((client for client in others if not policy.same(first, gateway, client)), None)
        if differs is not None:
            raise ConfigError(
                f"gateways: {first.name}.blocks",
                f"needed, since {first.name} and {gateway.name} have different permissions with {differs.name}:"
                " headsets are told apart by their block",
            )
    among = {
        tuple(policy.may(a, right, b) for right in RIGHTS) for a in policy.gateways for b in policy.gateways if a != b
    }
    if len(among) > 1:
        raise ConfigError(f"gateways: {first.name}.blocks", "needed, since gateways have different permissions")


def _once(what: str, values: Iterable[tuple[str, object]]) -> None:
    seen: dict[object, str] = {}
    for where, value in values:
        if value in seen:
            raise ConfigError(where, f"{what} {value} is {seen[value].partition(': ')[2]}'s already")
        seen[value] = where


def _known(where: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise ConfigError(where, _unknown(name, known))


def _unknown(name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"there is no {name!r} here" + (f", did you mean {near[0]!r}?" if near else "")


def _listed(names: Names) -> list[str]:
    return [names] if isinstance(names, str) else names


def _is_ip(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
