"""JSON that others wrote, read with limits: how large it may be, of how many parts, how deep; its keys in snake_case.

Existing programs spell keys in camelCase, UpperCamelCase or snake_case, and unknown ones are ignored.
"""

from __future__ import annotations

import re
from functools import cache, lru_cache
from typing import Any, TypeVar

import msgspec
from msgspec import Struct

from ..errors import BadField, BadJson, TooLong
from .limits import ANSWER_BYTES, ANSWER_PARTS, JSON_FIELDS, JSON_PARTS, METADATA_BYTES, NESTING

StructT = TypeVar("StructT", bound=Struct)


def judged(what: str, data: bytes | bytearray | memoryview, max_bytes: int, max_parts: int = JSON_PARTS) -> bytes:
    """The same bytes, if they may be parsed: not too many, and not made of too many parts. Raises TooLong or BadJson,
    which name ``what``."""
    if len(data) > max_bytes:
        raise TooLong(what, len(data), max_bytes)
    data = bytes(data)
    if len(data) > METADATA_BYTES:
        keys, nested, most = data.count(b":"), data.count(b"[") + data.count(b"{"), max_parts
        if max_bytes >= ANSWER_BYTES:
            keys, most = keys + nested + data.count(b","), ANSWER_PARTS
        if (parts := max(keys, nested)) > most:
            raise BadJson(what, f"it has {parts} parts, at most {most} are allowed")
    return data


def answered(what: str, answer: bytes) -> dict[str, Any]:
    """The object in an answer that one asked for oneself, its keys as they are. Raises TooLong, BadJson.

    It is what other readers of JSON take as well: no number that is none, no half of a character.
    """
    return _object(what, judged(what, answer, ANSWER_BYTES))


def snake_object(what: str, data: bytes) -> dict[str, Any]:
    """The object in ``data`` with its top-level keys in snake_case. Raises BadJson."""
    return {snake(key): field for key, field in json_object(what, data).items()}


def json_object(what: str, data: bytes) -> dict[str, Any]:
    """The object in ``data``, its keys as they are. Raises BadJson."""
    value = _object(what, data)
    if len(value) > JSON_FIELDS:
        raise BadJson(what, f"{len(value)} keys, at most {JSON_FIELDS} are allowed")
    return value


def _object(what: str, data: bytes) -> dict[str, Any]:
    try:
        value = msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadJson(what, str(error)) from error
    if not isinstance(value, dict):
        raise BadJson(what, f"an object was expected, not {type(value).__name__}")
    if data.count(b"[") + data.count(b"{") > NESTING and is_deep(value):
        raise BadJson(what, f"more than {NESTING} objects and lists in each other")
    return value


def is_deep(value: object) -> bool:
    """Whether more than ``NESTING`` objects and lists lie in each other: readers elsewhere follow less than we do."""
    level: list[object] = [value]
    for _ in range(NESTING + 1):
        inner: list[object] = []
        for one in level:
            if isinstance(one, dict | list):
                inner += one.values() if isinstance(one, dict) else one
        level = inner
    return bool(level)


def converted(what: str, fields: dict[str, Any], kind: type[StructT]) -> StructT:
    """Fields in snake_case as a ``kind``; those that it does not have are left out. Raises BadField."""
    names = wire_names(kind)
    known = {names[key]: value for key, value in fields.items() if key in names}
    if (nested := known.get("functionality")) and isinstance(nested, dict) and len(nested) <= JSON_FIELDS:
        known["functionality"] = {snake(key): value for key, value in nested.items()}
    try:
        return msgspec.convert(known, kind)
    except msgspec.ValidationError as error:
        raise BadField(what, str(error)) from error


@cache
def wire_names(kind: type[Struct]) -> dict[str, str]:
    """The name of each field in Python and on the wire."""
    return dict(zip(kind.__struct_fields__, kind.__struct_encode_fields__, strict=True))


def fields_of(value: Struct) -> dict[str, Any]:
    """What a struct says, by names on the wire; without what is None."""
    fields: dict[str, Any] = msgspec.to_builtins(value)
    return {key: field for key, field in fields.items() if field is not None}


_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
_LONGEST_KEY = 64
"""No key of ours is longer; longer ones are not remembered, because a peer chooses them."""


def snake(key: str) -> str:
    """A key in snake_case, whatever it is written in; one that is longer than any of ours as it is."""
    return _short_snake(key) if len(key) <= _LONGEST_KEY else key


@lru_cache(maxsize=1024)
def _short_snake(key: str) -> str:
    return _HUMP.sub("_", key).lower()
