"""The hash of a ROS type (REP 2016, ``RIHS01``): SHA-256 of its description as JSON, with all types that it uses."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

TYPE_IDS = {
    name: number
    for number, name in enumerate(
        [
            "nested",
            "int8",
            "uint8",
            "int16",
            "uint16",
            "int32",
            "uint32",
            "int64",
            "uint64",
            "float32",
            "float64",
            "float128",
            "char",
            "wchar",
            "bool",
            "byte",
            "string",
            "wstring",
            "fixed_string",
            "fixed_wstring",
            "bounded_string",
            "bounded_wstring",
        ],
        start=1,
    )
}
"""As type_description_interfaces/msg/FieldType numbers what one item can be."""
ARRAY, BOUNDED, UNBOUNDED = 48, 96, 144
"""What is added for an array of fixed length, a sequence with a bound, and one without."""

EMPTY_FIELD = "structure_needs_at_least_one_member"


class Field(NamedTuple):
    """One field. ``base`` is a name of `TYPE_IDS`, or ``nested`` with ``of`` the type's full name; ``items`` is 0, or
    one of `ARRAY`, `BOUNDED` and `UNBOUNDED` with ``capacity``."""

    name: str
    base: str
    of: str = ""
    items: int = 0
    capacity: int = 0
    string_capacity: int = 0


Fields = Callable[[str], Sequence[Field]]
"""The fields of a type by its full name, as ``std_msgs/msg/String``, in their order."""


def hash_of(name: str, fields: Fields) -> str:
    """The hash of a message."""
    described = {type_name: _described(type_name, fields(type_name)) for type_name in _used(name, fields)}
    own = described.pop(name)
    text = json.dumps(
        {
            "type_description": own,
            "referenced_type_descriptions": [described[type_name] for type_name in sorted(described)],
        }
    )
    return f"RIHS01_{hashlib.sha256(text.encode()).hexdigest()}"


def hash_of_service(name: str, fields: Fields) -> str:
    """The hash of a service by its full name: that of a message with a request, a response and an event of it.
    ``fields`` has to know ``…_Request`` and ``…_Response``."""
    parts = [(f"{part}_message", f"{name}_{part.capitalize()}") for part in ("request", "response", "event")]
    event = [
        Field("info", "nested", "service_msgs/msg/ServiceEventInfo"),
        *(Field(part, "nested", f"{name}_{part.capitalize()}", BOUNDED, 1) for part in ("request", "response")),
    ]
    made = {name: [Field(field, "nested", of) for field, of in parts], f"{name}_Event": event}
    return hash_of(name, lambda asked: made[asked] if asked in made else fields(asked))


def _used(name: str, fields: Fields) -> Iterator[str]:
    """A type and all that it is made of, each once."""
    waiting, seen = [name], {name}
    while waiting:
        yield (current := waiting.pop())
        for field in fields(current):
            if field.of and field.of not in seen:
                seen.add(field.of)
                waiting.append(field.of)


def _described(name: str, fields: Sequence[Field]) -> dict[str, object]:
    return {
        "type_name": name,
        "fields": [
            {
                "name": field.name,
                "type": {
                    "type_id": field.items + TYPE_IDS[field.base],
                    "capacity": field.capacity,
                    "string_capacity": field.string_capacity,
                    "nested_type_name": field.of,
                },
            }
            for field in fields or [Field(EMPTY_FIELD, "uint8")]
        ],
    }
