"""Definitions of ROS types as robots tell them (verb ``definitions``), and the schemas that are made of them. Pure.

A definition is the text of a ``.msg``, ``.srv`` or ``.action`` file. A schema is what recordings and viewers want: the
text of one message and of all that it needs, as MCAP's registry has ``ros2msg``.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping
from typing import Annotated

from msgspec import Meta, Struct

from .limits import ANSWER_BYTES, NAME_BYTES

TYPES_AT_ONCE = 256
"""So many types one request may name."""
TEXT_BYTES = 128 << 10
"""One definition; those that exist have at most 10 KiB."""
SCHEMA_BYTES = 256 << 10
"""One schema, with all that it needs; those that exist have a tenth of that."""
TELL_BYTES = ANSWER_BYTES * 3 // 4
"""So much text is in one answer; JSON writes a line's end in two bytes."""

TypeName = Annotated[str, Meta(min_length=3, max_length=NAME_BYTES)]


class DefinitionsRequest(Struct, frozen=True):
    """What the verb ``definitions`` is asked: these types, as ``geometry_msgs/msg/Twist``; none: all it offers."""

    types: Annotated[list[TypeName], Meta(max_length=TYPES_AT_ONCE)] = []


class Definition(Struct, frozen=True):
    """The text of a type, and its hash as ROS writes it (``RIHS01_…``); empty where the robot does not know it."""

    text: str
    hash: str = ""


class DefinitionsReply(Struct, frozen=True):
    """By full name: the types that were asked for and those that they need, and why others are not there.

    ``left`` are types that had no place in this answer: ask for them again.
    """

    definitions: dict[str, Definition] = {}
    missing: dict[str, str] = {}
    left: list[str] = []


BASE_TYPES = frozenset({"bool", "byte", "char", "float32", "float64", "string", "wstring"}) | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}

_FIELD = re.compile(r"\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?:\[(?:<=)?\d*\])?\s+[A-Za-z]\w*\b")
_PARTS = {"srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
_RULE = "=" * 80


def full_type(name: str, kind: str = "msg") -> str:
    """``geometry_msgs/Twist`` → ``geometry_msgs/msg/Twist``; what has three parts stays as it is."""
    package, _, rest = name.partition("/")
    return name if "/" in rest else f"{package}/{kind}/{rest}"


def needs(name: str, text: str) -> list[str]:
    """The types that a definition names, by full name, each once and in order."""
    package = name.partition("/")[0]
    found: dict[str, None] = {}
    for line in text.splitlines():
        match = _FIELD.match(line.partition("#")[0])
        if match is None or match["type"] in BASE_TYPES:
            continue
        short = match["type"]
        if "/" not in short:
            short = f"std_msgs/{short}" if short == "Header" else f"{package}/{short}"
        found[full_type(short)] = None
    return list(found)


def text_of(name: str, definitions: Mapping[str, Definition]) -> str | None:
    """The text of a message: of ``pkg/msg/Name``, or of a half of a service or a part of an action, as
    ``std_srvs/srv/SetBool_Request``; None when it is not known."""
    if (own := definitions.get(name)) is not None and name.split("/")[1:2] not in (["srv"], ["action"]):
        return own.text
    whole, _, part = name.rpartition("_")
    kind = name.split("/")[1] if name.count("/") == 2 else ""
    if part not in _PARTS.get(kind, ()) or (of_service := definitions.get(whole)) is None:
        return None
    pieces: list[list[str]] = [[]]
    for line in of_service.text.splitlines():
        if line.strip() == "---":
            pieces.append([])
        else:
            pieces[-1].append(line)
    parts = _PARTS[kind]
    return "\n".join(pieces[parts.index(part)]) + "\n" if len(pieces) == len(parts) else None


def schema(name: str, definitions: Mapping[str, Definition]) -> str | None:
    """The ``ros2msg`` text of a message type with all that it needs; None when a part of it is not known, or it is
    longer than such a text may be."""
    pieces: list[str] = []
    waiting, named, room = deque([name]), {name}, SCHEMA_BYTES
    while waiting:
        needed = waiting.popleft()
        text = text_of(needed, definitions)
        package, _, short = needed.partition("/msg/")
        if text is None or (pieces and not short) or (room := room - len(text)) < 0:
            return None
        pieces.append((f"{_RULE}\nMSG: {package}/{short}\n" if pieces else "") + text.rstrip("\n"))
        more = [each for each in needs(needed, text) if each not in named]
        named.update(more)
        waiting += more
    return "\n".join(pieces) + "\n"


def definitions_in(name: str, text: str) -> dict[str, Definition]:
    """The other way: what a schema consists of, by full name."""
    found: dict[str, Definition] = {}
    own, *others = re.split(r"^={3,}\r?\n", text, flags=re.MULTILINE)
    found[name] = Definition(own)
    for other in others:
        first, _, rest = other.partition("\n")
        if first.startswith("MSG: "):
            found[full_type(first.removeprefix("MSG: ").strip())] = Definition(rest)
    return found


_DYNAMIC = re.compile(r"\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?\[(?:<=\d+)?\]\s")
_LARGE = frozenset({"float64", "int64", "uint64"})


def unity_differs(name: str, definitions: Mapping[str, Definition]) -> bool:
    """Whether Unity's serializer may write and read a type otherwise than ROS does: wstring, structures without
    fields, and lists of numbers of eight bytes. True where that cannot be told."""
    seen: set[str] = set()
    waiting = [name]
    while waiting:
        each = waiting.pop()
        if each in seen:
            continue
        seen.add(each)
        text = text_of(each, definitions)
        if text is None:
            return True
        fields = 0
        for line in text.splitlines():
            line = line.partition("#")[0]
            match = _FIELD.match(line)
            if match is None or re.match(r"\s*\S+\s+\w+\s*=", line):
                continue
            fields += 1
            dynamic = _DYNAMIC.match(line)
            if match["type"] == "wstring" or (dynamic is not None and dynamic["type"] in _LARGE):
                return True
        if not fields:
            return True
        waiting += needs(each, text)
    return False
