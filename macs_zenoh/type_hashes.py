"""The hashes of ROS types whose definitions `typed` knows, and definitions that a ROS node describes. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from . import definitions
from .protocol.rmw_zenoh.type_hash import ARRAY, BOUNDED, TYPE_IDS, UNBOUNDED, Field, hash_of, hash_of_service
from .typed import PARTS, Types, UnknownType

GOAL_ID = Field("goal_id", "nested", "unique_identifier_msgs/msg/UUID")
STAMP = Field("stamp", "nested", "builtin_interfaces/msg/Time")

DESCRIBED_TYPES = 512
"""A description with more is not read."""

_FIELD_NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_]{0,127}")
_TYPE_NAME = re.compile(r"[a-z][a-z0-9_]{0,127}/(msg|srv|action)/[A-Z][a-zA-Z0-9_]{0,127}")
_NAMES = {number: name for name, number in TYPE_IDS.items()}
_ITEMS = 48
"""Type ids of arrays and sequences are those of their items and a multiple of this."""


class Hashes:
    """Hashes by type. Raises UnknownType for one that has no definition here."""

    def __init__(self, types: Types) -> None:
        self._types = types
        self._of = lru_cache(maxsize=1024)(self._hash)

    def of(self, name: str) -> str:
        """Of a message, a service, or a service or message that an action consists of: ``std_msgs/msg/String``,
        ``std_srvs/srv/SetBool``, ``demo_msgs/action/Turn_SendGoal``, ``…_GetResult``, ``…_FeedbackMessage``."""
        return self._of(name)

    def _hash(self, name: str) -> str:
        is_service = "/srv/" in name or name.endswith(("_SendGoal", "_GetResult"))
        return hash_of_service(name, self._fields) if is_service else hash_of(name, self._fields)

    def _fields(self, name: str) -> Sequence[Field]:
        if "/action/" in name and (made := _of_action(name)) is not None:
            return made
        return [_field(field, description) for field, description in self._types.fields(name)]


def _of_action(name: str) -> Sequence[Field] | None:
    """What ROS makes of an action by itself."""
    action, _, part = name.rpartition("_")
    if part == "FeedbackMessage":
        return [GOAL_ID, Field("feedback", "nested", f"{action}_Feedback")]
    action, _, service = action.rpartition("_")
    made = {
        ("SendGoal", "Request"): [GOAL_ID, Field("goal", "nested", f"{action}_Goal")],
        ("SendGoal", "Response"): [Field("accepted", "bool"), STAMP],
        ("GetResult", "Request"): [GOAL_ID],
        ("GetResult", "Response"): [Field("status", "int8"), Field("result", "nested", f"{action}_Result")],
    }
    return made.get((service, part))


def _field(name: str, description: Any) -> Field:
    kind, detail = description
    items, capacity = 0, 0
    if kind.name in ("ARRAY", "SEQUENCE"):
        (kind, detail), capacity = detail
        items = ARRAY if description[0].name == "ARRAY" else BOUNDED if capacity else UNBOUNDED
    if kind.name == "NAME":
        if (wide := definitions.WIDE.fullmatch(detail)) is not None:
            limit = int(wide["limit"] or 0)
            return Field(name, "bounded_wstring" if limit else "wstring", "", items, capacity, limit)
        return Field(name, "nested", detail, items, capacity)
    base, limit = detail
    if base == "string" and limit:
        return Field(name, "bounded_string", "", items, capacity, limit)
    return Field(name, "uint8" if base == "char" else base, "", items, capacity)  # as rosidl has it


def text_of(types: Types, name: str) -> str:
    """The text of a definition, without constants and comments. Raises UnknownType."""
    kind = name.split("/")[1]
    parts = [f"{name}_{part}" for part in PARTS.get(kind, ())] or [name]
    return "---\n".join("".join(f"{_line(*field)}\n" for field in types.fields(part)) for part in parts)


def _line(name: str, description: Any) -> str:
    kind, detail = description
    behind = ""
    if kind.name in ("ARRAY", "SEQUENCE"):
        most = detail[1]
        behind = f"[{most}]" if kind.name == "ARRAY" else f"[<={most}]" if most else "[]"
        kind, detail = detail[0]
    if kind.name == "NAME":
        wide = definitions.WIDE.fullmatch(detail)
        base, limit = ("wstring", int(wide["limit"] or 0)) if wide else (detail.replace("/msg/", "/"), 0)
    else:
        base, limit = detail
    return f"{base}{f'<={limit}' if limit else ''}{behind} {name}"


def learn(types: Types, description: Mapping[str, Any]) -> None:
    """Know what a type_description_interfaces/TypeDescription describes, as far as it is not known already. Raises
    UnknownType: it describes what there cannot be."""
    described = [description["type_description"], *description["referenced_type_descriptions"]]
    if len(described) > DESCRIBED_TYPES:
        raise UnknownType(str(described[0]["type_name"])[:80], f"its description has {len(described)} types")
    waiting = {str(one["type_name"]): one["fields"] for one in described}
    while waiting:
        ready = [
            name
            for name, fields in waiting.items()
            if not {str(field["type"]["nested_type_name"]) for field in fields} & waiting.keys()
        ]
        if not ready:
            raise UnknownType(next(iter(waiting))[:80], "its description goes round in a circle")
        for name in ready:
            fields = waiting.pop(name)
            if _is_whole(name) and not _is_known(types, name):
                types.add(name, "\n".join(map(_written, fields)))


def _is_whole(name: str) -> bool:
    """Whether this is a message, not a service or action that is described as one, nor what ROS adds to those."""
    made = ("_Event", "_SendGoal_Request", "_SendGoal_Response", "_GetResult_Request", "_GetResult_Response")
    parts = ("_Request", "_Response", "_Goal", "_Result", "_Feedback")
    return "/msg/" in name or (name.endswith(parts) and not name.endswith(made))


def _is_known(types: Types, name: str) -> bool:
    try:
        types.fields(name)
    except UnknownType:
        return False
    return True


def _written(field: Mapping[str, Any]) -> str:
    """A field as a definition has it. Raises UnknownType."""
    of_type, name = field["type"], str(field["name"])
    if _FIELD_NAME.fullmatch(name) is None:
        raise UnknownType(name[:80], "no field is called so")
    items, number = divmod(int(of_type["type_id"]) - 1, _ITEMS)
    base = _NAMES.get(number + 1)
    if base is None or items > UNBOUNDED // _ITEMS:
        raise UnknownType(name, f"there is no type number {of_type['type_id']}")
    if base == "nested":
        base = str(of_type["nested_type_name"])
        if _TYPE_NAME.fullmatch(base) is None:
            raise UnknownType(base[:80], "no type is called so")
    elif base.startswith("bounded_"):
        base = f"{base.removeprefix('bounded_')}<={int(of_type['string_capacity'])}"
    capacity = int(of_type["capacity"])
    return f"{base}{['', f'[{capacity}]', f'[<={capacity}]', '[]'][items]} {name}"
