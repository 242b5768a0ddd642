"""The keys of rmw_zenoh: data and services, liveliness tokens, and what advanced publishers have beside their key.

Nothing else spells them. A token says of a ROS node, or of one of its endpoints, all that ``ros2 topic info`` shows.
"""

from __future__ import annotations

import re
from enum import Enum
from typing import NamedTuple

from macs_zenoh.errors import UsageError, WireError

from .qos import Qos, parse_qos, written_qos

TOKEN_CHARACTERS = 4096
"""A longer token is not looked at."""
MORE_CHUNKS = 4
"""So many chunks behind the QoS may be there: a newer rmw_zenoh adds some."""

ADMIN = "@ros2_lv"
NOTHING = "%"
"""An empty chunk, as of the root namespace."""
NO_TYPE, NO_HASH = "EMPTY_TOPIC_TYPE", "EMPTY_TOPIC_HASH"
HASH_NOT_SUPPORTED = "TypeHashNotSupported"
"""What Humble has instead of a hash: it knows none."""
CPU_GROUP = "_buf_cpu"
CPU_BACKENDS = "backends:cpu:"
"""In Lyrical: where a publisher puts messages with buffers for who says in its token that it takes them from there."""


class Kind(Enum):
    """What a token stands for."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


class BadToken(WireError):
    """A key under ``@ros2_lv`` that is no token of a ROS node or endpoint."""

    def __init__(self, token: str, problem: str) -> None:
        super().__init__(f"{token[:120]!r} is no token of a ROS endpoint: {problem}")
        self.problem = problem


class BadName(UsageError):
    """A name or type that ROS does not have."""


class Node(NamedTuple):
    """A ROS node. ``zid`` and ``nid`` say which session's, and which of it."""

    domain: int
    zid: str
    nid: int
    enclave: str
    namespace: str
    name: str

    @property
    def full_name(self) -> str:
        """As ``/robot1/talker``."""
        return f"{self.namespace.rstrip('/')}/{self.name}"


class Endpoint(NamedTuple):
    """A publisher, subscription, service or client of a node.

    Attributes:
        topic: full name of the topic or service.
        type: ``std_msgs/msg/String``; empty when the token does not say.
        hash: of the type, as it stands in keys.
        more: chunks behind the QoS, which newer releases add.
    """

    node: Node
    id: int
    kind: Kind
    topic: str
    type: str
    hash: str
    qos: Qos
    more: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """The key of its data, or of its service."""
        return data_key(self.node.domain, self.topic, self.type, self.hash)

    @property
    def takes_cpu_buffers(self) -> bool:
        """Whether it takes messages with buffers from a key beside its own (Lyrical)."""
        return CPU_BACKENDS in self.more


_DIGITS = re.compile(r"[0-9]{1,10}")
_ZID = re.compile(r"[0-9a-f]{1,32}")
_NODE_NAME = re.compile(r"[A-Za-z0-9_]{1,255}")
_NAME = re.compile(r"(/[A-Za-z0-9_]+)+")
_HASH = re.compile(r"[A-Za-z0-9_]{1,128}")
_MORE = re.compile(r"[^/*$?#]{1,256}")
_DDS_TYPE = re.compile(r"(?P<package>[a-z][a-z0-9_]*)::(?P<kind>msg|srv|action)::dds_::(?P<name>[A-Z]\w*)_", re.ASCII)
_ROS_TYPE = re.compile(r"(?P<package>[a-z][a-z0-9_]*)/(?P<kind>msg|srv|action)/(?P<name>[A-Z]\w*)", re.ASCII)


def dds_type(ros_type: str) -> str:
    """``std_msgs/msg/String`` → ``std_msgs::msg::dds_::String_``, as keys have it. Raises BadName."""
    match = _ROS_TYPE.fullmatch(ros_type)
    if match is None:
        raise BadName(f"{ros_type[:80]!r} is not a ROS type, as std_msgs/msg/String")
    return f"{match['package']}::{match['kind']}::dds_::{match['name']}_"


def ros_type(dds: str) -> str:
    """``std_msgs::msg::dds_::String_`` → ``std_msgs/msg/String``; empty for anything else."""
    match = _DDS_TYPE.fullmatch(dds)
    return f"{match['package']}/{match['kind']}/{match['name']}" if match is not None else ""


def check_name(name: str) -> str:
    """A full name of a topic or service, itself. Raises BadName."""
    if _NAME.fullmatch(name) is None or len(name) > TOKEN_CHARACTERS // 4:
        raise BadName(f"{name[:80]!r} is not the full name of a topic or service, as /robot1/pose")
    return name


def data_key(domain: int, name: str, of_type: str, type_hash: str) -> str:
    """The key of a topic's data, or of a service. Raises BadName."""
    chunk = dds_type(of_type) if of_type else NO_TYPE
    if _HASH.fullmatch(type_hash) is None:
        raise BadName(f"{type_hash[:80]!r} is no type hash")
    return f"{domain}/{check_name(name)[1:]}/{chunk}/{type_hash}"


def cpu_key(key: str) -> str:
    """Where a publisher of Lyrical puts messages with buffers for subscriptions that say so."""
    return f"{key}/{CPU_GROUP}"


def node_token(node: Node) -> str:
    """The token of a node."""
    return f"{_begin(node)}/{node.nid}/{Kind.NODE.value}/{_of(node)}"


def endpoint_token(endpoint: Endpoint) -> str:
    """The token of an endpoint. Raises BadName."""
    node = endpoint.node
    name = _mangled(check_name(endpoint.topic))
    chunk = dds_type(endpoint.type) if endpoint.type else NO_TYPE
    what = (endpoint.kind.value, _of(node), name, chunk, endpoint.hash, written_qos(endpoint.qos), *endpoint.more)
    return "/".join((_begin(node), str(endpoint.id), *what))


def every_token(domain: int | None = None) -> str:
    """The key expression of all tokens, or of one domain's."""
    return f"{ADMIN}/**" if domain is None else f"{ADMIN}/{domain}/**"


def parse_token(token: str) -> Node | Endpoint:
    """A node or an endpoint, by its token. Raises BadToken."""
    if len(token) > TOKEN_CHARACTERS:
        raise BadToken(token, f"it has {len(token)} characters")
    chunks = token.split("/")
    if len(chunks) < 9 or chunks[0] != ADMIN:
        raise BadToken(token, "parts are missing")
    _, domain, zid, nid, id_, kind_name, enclave, namespace, name, *rest = chunks
    kind = next((kind for kind in Kind if kind.value == kind_name), None)
    if kind is None:
        raise BadToken(token, f"{kind_name[:8]!r} is no kind of endpoint")
    if not all(map(_DIGITS.fullmatch, (domain, nid, id_))) or _ZID.fullmatch(zid) is None:
        raise BadToken(token, "its numbers are none")
    if _NODE_NAME.fullmatch(name) is None:
        raise BadToken(token, f"{name[:40]!r} is no name of a node")
    places = (_plain(token, enclave) or "/", _plain(token, namespace) or "/")
    node = Node(int(domain), zid, int(nid), *places, name)
    if kind is Kind.NODE:
        return node
    if not 4 <= len(rest) <= 4 + MORE_CHUNKS:
        raise BadToken(token, f"{len(rest)} parts behind the node, not 4")
    topic, dds, type_hash, qos, *more = rest
    if _HASH.fullmatch(type_hash) is None or not all(map(_MORE.fullmatch, (dds, *more))):
        raise BadToken(token, "its type is none")
    full = _plain(token, topic)
    if not full:
        raise BadToken(token, "it has no topic")
    found = parse_qos(qos)
    if found is None:
        raise BadToken(token, f"{qos[:60]!r} is no QoS")
    return Endpoint(node, int(id_), kind, full, ros_type(dds), type_hash, found, tuple(more))


def session_keys(namespace: str) -> list[str]:
    """All keys of ROS nodes whose sessions are in a namespace: data and services, tokens, what publishers keep."""
    return [f"{namespace}/**", f"{namespace}/{ADMIN}/**", f"{namespace}/**/@adv/**"]


def probe_key(namespace: str, mark: str) -> str:
    """A key there that is no topic of any node, to try who may put it."""
    return f"{namespace}/0/{mark}"


def kept_by(key: str) -> str:
    """Where all that advanced publishers of a key keep, and say of themselves, can be had."""
    return f"{key}/@adv/pub/**"


def _begin(node: Node) -> str:
    return f"{ADMIN}/{node.domain}/{node.zid}/{node.nid}"


def _of(node: Node) -> str:
    return f"{_mangled(node.enclave)}/{_mangled(node.namespace)}/{node.name}"


def _mangled(name: str) -> str:
    """A name as one chunk."""
    return name.replace("/", NOTHING) or NOTHING


def _plain(token: str, chunk: str) -> str:
    """A name out of its chunk, with one slash in front and none behind; empty for the root. Raises BadToken."""
    name = "/" + chunk.replace(NOTHING, "/").strip("/")
    if name == "/":
        return ""
    if _NAME.fullmatch(name) is None:
        raise BadToken(token, f"{chunk[:60]!r} is no name")
    return name
