"""The vectors that come with the package: bytes of the protocol, each with what it is made of. Pure but for reading.

A file is ``{"format": 1, "about", "values": {name: example}, "vectors": [...]}``. A vector has ``name``, ``about``,
what it is made of, and ``hex``: all of it with the example values. docs/conformance.md explains the members to those
who write a program in another language.

``python -m bridge.conformance.vectors`` writes ``hex`` anew from what the vectors are made of.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

FOLDER = Path(__file__).parent / "vectors"
FILES = ("headset_frames", "robot_frames", "router_messages", "bad_frames", "bad_messages")
FORMAT = 1

Value = int | str
Values = Mapping[str, Value]

_HEADER = struct.Struct("<B10H10BII")
_SIZE = struct.Struct("<I")


class Vector(NamedTuple):
    """One row of a file. ``parts`` is what it is made of, ``marks`` what else it says, as ``deafens_existing``."""

    name: str
    about: str
    file: str
    parts: Mapping[str, Any]
    marks: Mapping[str, Any]
    example: bytes

    def fill(self, values: Values) -> bytes:
        """Its bytes with these values in place of the example's."""
        known = {**example_values(self.file), **values}
        return _message(self.parts, known) if self.is_message else _frame(self.parts, known)

    @property
    def is_message(self) -> bool:
        """Whether it goes from a router to an agent, without a header."""
        return self.file.endswith("_messages")


_PARTS = frozenset({"type", "ids", "groups", "management", "metadata", "data", "message", "says", "append"})


@cache
def read(file: str) -> tuple[Vector, ...]:
    """All vectors of a file, in their order."""
    rows = []
    for row in _content(file)["vectors"]:
        parts = {key: row[key] for key in row if key in _PARTS}
        marks = {key: row[key] for key in row if key not in _PARTS | {"name", "about", "hex"}}
        rows.append(Vector(row["name"], row["about"], file, parts, marks, bytes.fromhex(row["hex"])))
    return tuple(rows)


def named(file: str, name: str) -> Vector:
    """The vector of this name. Raises KeyError."""
    for vector in read(file):
        if vector.name == name:
            return vector
    raise KeyError(f"{file}: {name}")


def fill(file: str, name: str, **values: Value) -> bytes:
    """The bytes of the vector of this name with these values."""
    return named(file, name).fill(values)


def example_values(file: str) -> Values:
    """The values that the examples of a file are made with."""
    values: Values = _content(file)["values"]
    return values


@cache
def _content(file: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((FOLDER / f"{file}.json").read_text(encoding="utf-8"))
    if content["format"] != FORMAT:
        raise ValueError(f"{file}: format {content['format']}, this program reads {FORMAT}")
    return content


# -- from parts to bytes ---------------------------------------------------------------------------------------------


def _frame(parts: Mapping[str, Any], values: Values) -> bytes:
    management = _bytes(parts.get("management", ""), values)
    message = _message(parts, values)
    says = parts.get("says", {})
    header = _HEADER.pack(
        parts.get("type", 0),
        *_slots(parts.get("ids", []), values, 10),
        *_slots(parts.get("groups", []), values, 10),
        says.get("management", len(management)),
        says.get("message", len(message)),
    )
    return header + management + message + bytes.fromhex(parts.get("append", ""))


def _message(parts: Mapping[str, Any], values: Values) -> bytes:
    if "message" in parts:
        return bytes.fromhex(parts["message"])
    metadata, data = _bytes(parts.get("metadata", ""), values), _bytes(parts.get("data", ""), values)
    says = parts.get("says", {})
    sizes = _SIZE.pack(says.get("metadata", len(metadata))), _SIZE.pack(says.get("data", len(data)))
    return sizes[0] + metadata + sizes[1] + data


def _slots(named: list[Value], values: Values, count: int) -> list[int]:
    numbers = [int(_value(each, values)) for each in named]
    return numbers + [0] * (count - len(numbers))


def _bytes(part: Any, values: Values) -> bytes:
    """A part's bytes: text as it is; ``{"json"}``, compact or with ``spaced`` as Python writes it; ``{"hex"}``."""
    if isinstance(part, str):
        return part.encode()
    if "hex" in part:
        return bytes.fromhex(str(_value(part["hex"], values)))
    separators = (", ", ": ") if part.get("spaced") else (",", ":")
    return json.dumps(_value(part["json"], values), separators=separators).encode()


def _value(part: Any, values: Values) -> Any:
    """The same with each text ``$name`` replaced by that value."""
    if isinstance(part, dict):
        return {key: _value(each, values) for key, each in part.items()}
    if isinstance(part, list):
        return [_value(each, values) for each in part]
    if isinstance(part, str) and part.startswith("$"):
        return values[part[1:]]
    return part


def written(file: str) -> str:
    """The file as it should be: each ``hex`` made of the vector's parts."""
    content = _content(file)
    rows = []
    for row, vector in zip(content["vectors"], read(file), strict=True):
        rows.append({**row, "hex": vector.fill({}).hex()})
    head = json.dumps({key: content[key] for key in ("format", "about", "values")}, ensure_ascii=False)
    lines = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in rows)
    return f'{head[:-1]}, "vectors": [\n{lines}\n]}}\n'


if __name__ == "__main__":
    for each in FILES:
        (FOLDER / f"{each}.json").write_text(written(each), encoding="utf-8")
