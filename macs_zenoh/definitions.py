"""What `rosbags` leaves out of ROS definitions: services, defaults of fields, and wstring. Pure."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from typing import NamedTuple

from .errors import UsageError

WIDE_PACKAGE = "macs_wide"
WIDE = re.compile(rf"{WIDE_PACKAGE}/msg/W(?P<limit>\d*)")
"""Instead of wstring: a structure of its UTF-16 units, which is the same in CDR; with its limit if it has any."""

SERVICES = {
    "std_srvs/SetBool": "bool data\n---\nbool success\nstring message\n",
    "std_srvs/Trigger": "---\nbool success\nstring message\n",
    "std_srvs/Empty": "---\n",
    "action_msgs/CancelGoal": (
        "action_msgs/GoalInfo goal_info\n---\nint8 return_code\naction_msgs/GoalInfo[] goals_canceling\n"
    ),
    "type_description_interfaces/GetTypeDescription": (
        "string type_name\nstring type_hash\nbool include_type_sources true\n---\nbool successful\n"
        "string failure_reason\ntype_description_interfaces/TypeDescription type_description\n"
        "type_description_interfaces/TypeSource[] type_sources\n"
        "type_description_interfaces/KeyValue[] extra_information\n"
    ),
}
"""Services that everybody uses; rosbags has messages only."""

_FIELD = re.compile(r"\s*(?P<type>(?:[^\s=]|<=)+)\s+(?P<name>[a-zA-Z]\w*)(?P<rest>\s.*)?")
_WIDE_TYPE = re.compile(r"wstring(?:<=(?P<limit>\d+))?(?P<array>(?:\[.*\])?)")


class BadDefinition(UsageError):
    """A definition that cannot be read."""


class Definition(NamedTuple):
    """A definition as `rosbags` takes it, and what it would have lost.

    Attributes:
        text: without defaults, and with types of `WIDE_PACKAGE` in place of wstring.
        defaults: by field, as Python has them.
        wide: the names of those types that it needs.
    """

    text: str
    defaults: dict[str, object]
    wide: set[str]


def read(text: str) -> Definition:
    """Read a message, or half of a service. Raises BadDefinition for a default that is none."""
    lines, defaults, wide = [], {}, set()
    for line in text.splitlines():
        match = _FIELD.fullmatch(_without_comment(line))
        if match is None or (match["rest"] or "").lstrip().startswith("="):  # nothing, or a constant
            lines.append(line)
            continue
        of_type, name, default = match["type"], match["name"], (match["rest"] or "").strip()
        if default:
            defaults[name] = _value(of_type, name, default)
        if (wstring := _WIDE_TYPE.fullmatch(of_type)) is not None:
            short = f"W{wstring['limit'] or ''}"
            wide.add(short)
            of_type = f"{WIDE_PACKAGE}/{short}{wstring['array']}"
        lines.append(f"{of_type} {name}")
    return Definition("\n".join(lines), defaults, wide)


def units_of(text: str) -> list[int]:
    """The UTF-16 code units of a text. Raises UnicodeEncodeError for half a character."""
    data = text.encode("utf-16-le")
    return [int.from_bytes(data[at : at + 2], "little") for at in range(0, len(data), 2)]


def text_of(units: Iterator[int]) -> str:
    """The text of UTF-16 code units; what is none becomes a question mark in a box."""
    return b"".join((int(unit) & 0xFFFF).to_bytes(2, "little") for unit in units).decode("utf-16-le", "replace")


def _without_comment(line: str) -> str:
    quote = ""
    for at, letter in enumerate(line):
        if quote:
            quote = "" if letter == quote and line[at - 1] != "\\" else quote
        elif letter in "\"'":
            quote = letter
        elif letter == "#":
            return line[:at]
    return line


def _value(of_type: str, name: str, text: str) -> object:
    try:
        if of_type.endswith("]"):
            words = {"true": "True", "false": "False"}
            items = re.sub(r"\b(true|false)\b(?=\s*[,\]])", lambda word: words[word[0]], text)
            return list(ast.literal_eval(items))
        if of_type.startswith(("string", "wstring")):
            return str(ast.literal_eval(text)) if text[:1] in "\"'" else text
        if of_type == "bool":
            return {"true": True, "1": True, "false": False, "0": False}[text.lower()]
        return float(text) if of_type.startswith("float") else int(text, 0)
    except (ValueError, SyntaxError, KeyError, TypeError, MemoryError, RecursionError) as error:
        raise BadDefinition(f"{text[:80]!r} is no default for the field {name}, which is a {of_type}") from error
