"""Every key expression of the mesh, built and parsed in one place; nothing else spells a ``/``.

``keyexpr_map.md`` explains the same table to people who write Zenoh programs or access rules; a test holds the two
together. Agent types are names in keys (``ros``, ``unity``, otherwise the number), ids and groups decimal.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Generic, TypeVar
from urllib.parse import quote, unquote

from ..errors import UsageError
from .key_fields import (
    BroadcastFields,
    CallFields,
    CallsFields,
    Fields,
    GroupFields,
    LastFields,
    LeaseFields,
    NamedAllFields,
    NamedFields,
    NameFields,
    PingFields,
    PresenceFields,
    SlowFields,
    StreamFields,
    UnicastFields,
    WantedFields,
)
from .limits import CHUNK_BYTES, KEY_BYTES
from .messages import OPERATOR, ROS, UNITY

BLOCK_SIZE = 256
"""Ids per block: the block of an id is its high byte."""

_TYPE_NAMES = {ROS: "ros", UNITY: "unity", OPERATOR: "operator"}
_TYPE_NUMBERS = {name: number for number, name in _TYPE_NAMES.items()}

FieldValue = int | str

WRITTEN = 4096
"""How many fields of keys are remembered as they are written."""

_NEW = frozenset({"zid"})
"""Not these: there is another one for each agent that comes and each time that one sleeps, and none comes again."""

_TYPES = frozenset({"type", "from_type"})
_RANGES = {
    "type": (1, 255),
    "from_type": (1, 255),
    "id": (0, 0xFFFF),
    "from_id": (0, 0xFFFF),
    "group": (0, 255),
    "block": (0, 255),
    "from_block": (0, 255),
}
_SAFE = "".join({chr(c) for c in range(32, 127)} - set("/*$?#%"))


def type_name(agent_type: int) -> str:
    """How an agent type is written in keys: 1 → ``ros``, 2 → ``unity``, 255 → ``operator``, others as the number."""
    return _TYPE_NAMES.get(agent_type) or str(agent_type)


def type_number(name: str | int) -> int:
    """The agent type behind a name: ``ros`` → 1, ``unity`` → 2, ``"7"`` → 7, itself for a number. Raises
    UsageError."""
    number = _TYPE_NUMBERS.get(name) if isinstance(name, str) else None
    if number is None:
        name = str(name)
        if len(name) > 3 or not name.isascii() or not name.isdigit() or not 1 <= int(name) <= 255:
            raise UsageError(f"unknown agent type {name!r}: use 'ros', 'unity', 'operator' or a number from 1 to 255")
        number = int(name)
    return number


def block_of(agent_id: int) -> int:
    """The block that an id belongs to."""
    return agent_id // BLOCK_SIZE


_F = TypeVar("_F", bound=tuple[Any, ...], covariant=True)


@dataclass(frozen=True)
class Key(Generic[_F]):
    """One key space: a template whose ``{fields}`` are single chunks, and who puts what there. What its keys say is
    ``read`` as a named tuple with these fields in their order."""

    template: str
    read: Callable[..., _F]
    publisher: str
    subscriber: str
    payload: str
    fields: tuple[str, ...] = field(init=False)
    _block_at: int | None = field(init=False, repr=False, compare=False)
    """Which field is the block of the id behind it; None where none is."""
    _names: frozenset[str] = field(init=False, repr=False, compare=False)
    _pattern: re.Pattern[str] = field(init=False, repr=False, compare=False)
    _templates: dict[frozenset[str], str] = field(init=False, repr=False, compare=False, default_factory=dict)
    """Those of expressions, by which fields are given."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "fields", tuple(re.findall(r"\{(\w+)\}", self.template)))
        object.__setattr__(self, "_names", frozenset(self.fields))
        object.__setattr__(self, "_block_at", self.fields.index("block") if {"block", "id"} <= self._names else None)
        pattern = re.sub(r"\{(\w+)\}", r"([^/*$?#]+)", self.template)
        object.__setattr__(self, "_pattern", re.compile(pattern))

    @property
    def prefix(self) -> str:
        """How each of its keys begins: ``macs/to/``."""
        return self.template.partition("{")[0]

    def of(self, **values: FieldValue) -> str:
        """The concrete key for these fields; an id's block need not be given. Raises UsageError when one is missing,
        unknown, cannot be written or is another id's block."""
        self._complete(values)
        if values.keys() != self._names and (missing := self._names - values.keys()):
            raise UsageError(f"key {self.template}: no value for {', '.join(sorted(missing))}")
        return self._fill(values)

    def every(self, **values: FieldValue) -> str:
        """The key expression for all keys with these fields; fields not given match anything.

        A tail in which nothing is given becomes ``**``, so ``UNICAST.every(type=1, id=7)`` is ``macs/to/ros/0/7/**``.
        """
        self._complete(values)
        given = frozenset(values)
        if given not in self._templates:
            self._templates[given] = self._template(given)
        return self._fill(values, self._templates[given])

    def _template(self, values: frozenset[str]) -> str:
        """The template of an expression in which these fields are given."""
        given = [name in values for name in self.fields]
        last = max((i for i, here in enumerate(given) if here), default=-1)
        tail = self.fields[last + 1 :]
        template = self.template
        if tail:
            template = template[: template.index("{" + tail[0] + "}")] + "**"
        for name in self.fields[: last + 1]:
            if name not in values:
                template = template.replace("{" + name + "}", "*")
        return template

    def parse(self, key: str) -> _F | None:
        """The fields of a concrete key (types and ids as numbers), or None when the key is not of this space."""
        match = self._pattern.fullmatch(key) if len(key) <= KEY_BYTES else None
        if match is None:
            return None
        try:
            fields = self.read(*map(_field, self.fields, match.groups()))
        except (UsageError, ValueError):
            return None
        at = self._block_at
        return None if at is not None and fields[at] != block_of(fields[at + 1]) else fields

    def _complete(self, values: dict[str, FieldValue]) -> None:
        """Put the block of an id beside it."""
        if self._block_at is None or not isinstance(agent_id := values.get("id"), int):
            return
        block = block_of(agent_id)
        if values.setdefault("block", block) != block:
            raise UsageError(f"id {agent_id} is in block {block}, not {values['block']}")

    def _fill(self, values: dict[str, FieldValue], template: str | None = None) -> str:
        if not values.keys() <= self._names:
            unknown = values.keys() - self._names
            raise UsageError(f"key {self.template} has no field {', '.join(sorted(unknown))}")
        written = {name: (_write if name in _NEW else _written)(name, value) for name, value in values.items()}
        key = (template or self.template).format(**written)
        if len(key) > KEY_BYTES:
            raise UsageError(f"a key {self.template} of {len(key)} bytes, at most {KEY_BYTES} are allowed")
        return key


# -- keys beside the table: of Zenoh itself, of namespaces, of programs that look ------------------------------------

EVERYTHING = "macs/**"
"""Every key of the mesh."""
ROUTERS = "@/*/router"
"""The admin space of each router that shows it: version, sessions, addresses."""
ADMIN = (ROUTERS, ROUTERS + "/**")
"""The admin space of routers, read only: versions, sessions, links."""


def router_figures(zid: str) -> str:
    """What a router tells in few bytes: asked for to see how long the way to it is."""
    return f"@/{zid}/router/metrics"


_RECOVERY, _SOURCES = "@adv/**", "@adv/pub/"


def router(zid: str) -> str:
    """The admin space of one router."""
    return f"@/{zid}/router"


def router_links(zid: str) -> str:
    """Where a router tells which routers it is linked with."""
    return router(zid) + "/linkstate/north"


def with_recovery(keys: Iterable[str]) -> Iterator[str]:
    """Each key, and what the source of reliable messages and their receivers say behind it about lost ones."""
    for key in keys:
        yield key
        yield f"{key}/{_RECOVERY}"


def is_recovery(key: str) -> bool:
    """Whether a key is one of those about lost messages."""
    return key.endswith(_RECOVERY)


def sources(key: str, source: str = "") -> str:
    """Behind a key: its reliable sources, or one, as Zenoh's advanced publishers name them
    (``@adv/pub/{zid}/{entity}/_``)."""
    return f"{key}/{_SOURCES}{source}/**" if source else f"{key}/{_SOURCES}**"


def heartbeat(key: str, zid: str, entity: int) -> str:
    """The heartbeat of one reliable source of a key."""
    return f"{key}/{_SOURCES}{zid}/{entity}/_"


def source_of(key: str) -> tuple[str, str]:
    """The data's key and the source that a heartbeat's key names; both are empty for other keys."""
    data_key, _, source = key.removesuffix("/_").rpartition(f"/{_SOURCES}")
    return (data_key, source) if data_key else ("", "")


def inside(namespace: str | None, key: str) -> str:
    """A key as others see it who are in no namespace. The admin space of routers is in none."""
    return key if namespace is None or key.startswith("@") else f"{namespace}/{key}"


def everywhere(space: Key[Fields]) -> str:
    """All keys of a space in every namespace, and without one."""
    return "**/" + space.every()


def namespace_of(space: Key[Fields], key: str) -> str | None:
    """The namespace before a key of a space, empty for none; None for a key of no such space."""
    namespace, found, _ = key.rpartition(space.prefix)
    return namespace.rstrip("/") if found else None


def marked(key: str, mark: str) -> str:
    """The same key with a mark before its last chunk, so that programs do not take it for one of their own."""
    begin, _, last = key.rpartition("/")
    return f"{begin}/{mark}{last}"


def sender_of(key: str) -> str:
    """Type and id at the end of a key."""
    at = key.rfind("/", 0, max(0, key.rfind("/")))
    return key[at + 1 :]


def of_each(expression: str, agent_type: int, ids: Iterable[int]) -> list[str]:
    """An expression whose only wildcard is an id behind a type, once for each id; itself without any; else nothing."""
    if "*" not in expression:
        return [expression]
    begin, found, end = expression.partition(f"/{type_name(agent_type)}/*/")
    if not found or "*" in begin + end:
        return []
    return [f"{begin}/{type_name(agent_type)}/{number}/{end}" for number in ids]


@lru_cache(maxsize=WRITTEN, typed=True)
def _written(name: str, value: FieldValue) -> str:
    """`_write`, remembered: a key is made for each call and each agent, of the same few hundred values."""
    return _write(name, value)


def _write(name: str, value: FieldValue) -> str:
    if name in _TYPES and isinstance(value, str):
        value = type_number(value)
    if name in _RANGES:
        low, high = _RANGES[name]
        if type(value) is not int or not low <= value <= high:
            raise UsageError(f"{name} must be a number from {low} to {high}, not {value!r}")
        return type_name(value) if name in _TYPES else str(value)
    text = str(value)
    if not text:
        raise UsageError(f"{name} is empty")
    if len(text) > CHUNK_BYTES:
        raise UsageError(f"{name} has {len(text)} characters, a key takes at most {CHUNK_BYTES} bytes of it")
    try:
        chunk = quote(text, safe=_SAFE)
    except UnicodeEncodeError as error:
        raise UsageError(f"{name} {text!r} is no Unicode text") from error
    if len(chunk) > CHUNK_BYTES:
        raise UsageError(f"{name} takes {len(chunk)} bytes in a key, at most {CHUNK_BYTES} are allowed")
    return "%40" + chunk[1:] if chunk.startswith("@") else chunk  # Zenoh's wildcards do not match what starts with @


def _field(name: str, text: str) -> FieldValue:
    return _read(name, text) if name in _NEW else _known(name, text)


@lru_cache(maxsize=WRITTEN)
def _known(name: str, text: str) -> FieldValue:
    """`_read`, remembered likewise."""
    return _read(name, text)


def _read(name: str, text: str) -> FieldValue:
    value: FieldValue = unquote(text)
    if name in _TYPES:
        value = type_number(text)
    elif name in _RANGES:
        value = int(text)
    write = _write if name in _NEW else _written
    if write(name, value) != text:  # one way to write an agent: access rules for it cover all that is taken for it
        raise ValueError(text)
    return value


FRAME = "one frame, or several that one sender sent the same way at once, back to back"

UNICAST = Key(
    "macs/to/{type}/{block}/{id}/{from_type}/{from_id}",
    UnicastFields,
    publisher="the sender",
    subscriber="an agent: its own `{type}/{block}/{id}`; a gateway: its block of headsets, each of its TCP robots",
    payload=FRAME,
)
GROUP = Key(
    "macs/group/{group}/{type}/{from_type}/{from_id}",
    GroupFields,
    publisher="the sender",
    subscriber="an agent in the group; a gateway once, however many of its agents are in the group",
    payload=FRAME,
)
BROADCAST = Key(
    "macs/all/{from_type}/{from_id}",
    BroadcastFields,
    publisher="the sender",
    subscriber="every agent and gateway",
    payload=FRAME,
)
STREAM = Key(
    "macs/from/{type}/{id}/{node}",
    StreamFields,
    publisher="a robot, once per topic message",
    subscriber="every gateway with a registrant on that node",
    payload="one frame whose management data lists the registrants",
)
PRESENCE = Key(
    "macs/live/{type}/{block}/{id}/{group}/{zid}",
    PresenceFields,
    publisher="an agent, or the gateway it is behind (liveliness token)",
    subscriber="every agent and gateway",
    payload="none",
)
LEASE = Key(
    "macs/block/{block}/{zid}",
    LeaseFields,
    publisher="the gateway that hands out the ids of this block (liveliness token)",
    subscriber="gateways and agents that choose an id",
    payload="none",
)
CALL = Key(
    "macs/call/{type}/{id}/{verb}/{from_type}/{from_id}",
    CallFields,
    publisher="the caller (query)",
    subscriber="the agent that is called (queryable)",
    payload="one frame; the reply is one message",
)
CALLS = Key(
    "macs/calls/{type}/{id}/{verb}/{from_type}/block/{from_block}",
    CallsFields,
    publisher="who calls for several agents of one block at once, as its gateway may (query)",
    subscriber="the agent that is called (queryable)",
    payload="such calls as frames back to back, each with its caller; the reply is a JSON list: what came of each",
)

NAME = Key(
    "macs/name/{name}/{type}/{id}/{zid}",
    NameFields,
    publisher="an agent that other agents send to by name (liveliness token); id 0: a name without an agent",
    subscriber="agents that send by name, `macs ls`",
    payload="none",
)
WANTED = Key(
    "macs/ca/wanted/{name}/{message_type}/{zid}",
    WantedFields,
    publisher="a named agent, for each message type that somebody there has registered (liveliness token)",
    subscriber="agents that send by name",
    payload="none",
)
NAMED = Key(
    "macs/ca/to/{name}/{message_type}/by/{from_name}",
    NamedFields,
    publisher="the sender; a query where it wants to know that the message has arrived",
    subscriber="the named agent (also queryable)",
    payload="one message: envelope and data",
)
NAMED_ALL = Key(
    "macs/ca/all/{message_type}/by/{from_name}",
    NamedAllFields,
    publisher="the sender",
    subscriber="every named agent that has this message type registered",
    payload="one message: envelope and data",
)
LAST = Key(
    "macs/ca/last/{name}/{message_type}/by/{from_name}",
    LastFields,
    publisher="who wants the named agent's last message of a type to all (query)",
    subscriber="the named agent (queryable)",
    payload="none; the reply is one message: envelope and data",
)
PING = Key(
    "macs/ping/{zid}",
    PingFields,
    publisher="`macs doctor` (query; a put to itself, for the router's timestamp)",
    subscriber="every agent and gateway (queryable); the doctor's own second session",
    payload="any bytes; the reply is one message: facts in JSON, and the bytes back, or what they ask for",
)

SLOW = Key(
    "macs/slow/{zid}/{from_type}/{from_id}",
    SlowFields,
    publisher="the gateway of an agent that takes less than others send to it",
    subscriber="a gateway, for its own session: it reads less from the one that sends",
    payload="type and id of who sends, and whether to slow it down",
)

KEYS: dict[str, Key[Fields]] = {
    "unicast": UNICAST,
    "group": GROUP,
    "broadcast": BROADCAST,
    "stream": STREAM,
    "presence": PRESENCE,
    "lease": LEASE,
    "call": CALL,
    "calls": CALLS,
    "name": NAME,
    "wanted": WANTED,
    "named": NAMED,
    "named all": NAMED_ALL,
    "last value": LAST,
    "ping": PING,
    "slow": SLOW,
}
"""Every key space by its name."""


def parse(key: str) -> tuple[str, Fields] | None:
    """Which key space a concrete key belongs to, and its fields; None for a key that is not ours."""
    for name, space in KEYS.items():
        if (fields := space.parse(key)) is not None:
            return name, fields
    return None
