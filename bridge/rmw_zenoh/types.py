"""What is known of the types of a robot that has no ROS here: from rosbags, from files, or from the robot itself."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bridge.ros.shapes import Array, Number, Shape, Structure, Text
from bridge.ros.shapes import Sequence as Items
from bridge.ros.side import REASON_FIELDS, MessageType
from macs_zenoh import definitions
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.schemas import Definition
from macs_zenoh.type_hashes import Hashes, learn, text_of
from macs_zenoh.typed import BadCdr, BadValue, Types, UnknownType, request_of, response_of

log = logging.getLogger("macs.ros")

DESCRIPTION = "type_description_interfaces/srv/GetTypeDescription"
"""The service by which a ROS node says what its types consist of."""
_SIZES = {
    **dict.fromkeys(("bool", "byte", "char", "uint8", "int8"), 1),
    **dict.fromkeys(("uint16", "int16"), 2),
    **dict.fromkeys(("uint32", "int32", "float32"), 4),
    **dict.fromkeys(("uint64", "int64", "float64"), 8),
    "float128": 16,
}
_BOXED = frozenset({"bool", "byte", "char"})

Ask = Callable[[str, str, bytes], bytes | None]
"""Asks a node of the robot to describe a type, by the type's name and hash: the CDR of a `DESCRIPTION` request gives
that of its response, None when there is no such node or it does not answer."""


class KnownTypes:
    """Definitions, and the hashes that follow from them. Belongs to one thread."""

    def __init__(self, folders: Sequence[str | Path] = ()) -> None:
        """Raises MissingExtra, UnknownType: there is no such folder."""
        self.types = Types(folders)
        self.hashes = Hashes(self.types)
        self._asked: set[str] = set()

    def hash_of(self, name: str) -> str | None:
        """The hash of a type by its definition, None when there is none here."""
        try:
            return self.hashes.of(name)
        except UnknownType:
            return None

    def definition(self, name: str) -> Definition:
        """The text of a type's definition, and its hash. From any thread. Raises Refused."""
        try:
            return Definition(text_of(self.types, name), self.hash_of(name) or "")
        except UnknownType as error:
            raise Refused(f"the definition of {name} is not known here: {error.why}") from None

    def message(self, name: str, part: str, type_hash: str, ask: Ask) -> MessageType:
        """The type ``part``, which is ``name`` itself or a part of it; ``ask`` is asked when it has no definition."""
        try:
            self.types.fields(part)
        except UnknownType:
            self._learn(name, type_hash, ask)
        try:
            return KnownMessage(self.types, part)
        except UnknownType:
            return UnknownMessage(name)

    def _learn(self, name: str, type_hash: str, ask: Ask) -> None:
        if name in self._asked or not type_hash.startswith("RIHS"):
            return
        request = {"type_name": name, "type_hash": type_hash, "include_type_sources": False}
        response = ask(name, type_hash, self.types.serialize(request_of(DESCRIPTION), request))
        if response is None:
            return
        self._asked.add(name)
        try:
            described = self.types.deserialize(response_of(DESCRIPTION), response)
            if described["successful"]:
                learn(self.types, described["type_description"])
                log.info("the robot has described %s", name)
        except (BadCdr, UnknownType, KeyError, TypeError, ValueError) as error:
            log.warning("%s: the robot's description of it makes no sense: %s", name, error)


class KnownMessage(MessageType):
    """A type with a definition."""

    def __init__(self, types: Types, name: str) -> None:
        """Raises UnknownType."""
        self.shape = shape_of(types, name)
        super().__init__(self.shape)
        self._types = types
        self._name = name

    def filled(self, values: Mapping[str, Any], what: str) -> bytes:
        try:
            return self._types.serialize(self._name, values)
        except (BadValue, UnknownType) as error:
            raise Refused(f"{what} of this robot's settings does not fit: {error}") from error

    def failure(self, reason: str, values: Mapping[str, Any] | None, what: str) -> bytes:
        if values is None:
            fields = self._types.fields(self._name)
            values = {
                name: reason.replace("\0", "")
                for name, (kind, detail) in fields
                if name in REASON_FIELDS and kind.name == "BASE" and detail == ("string", 0)
            }
        return self.filled(values, what)


class UnknownMessage(MessageType):
    """A type of which nothing is known but its name: its messages pass as they are."""

    def __init__(self, name: str) -> None:
        super().__init__(None)
        self._name = name

    def filled(self, values: Mapping[str, Any], what: str) -> bytes:
        raise Refused(f"{what} of this robot's settings: the definition of {self._name} is not known here")

    def failure(self, reason: str, values: Mapping[str, Any] | None, what: str) -> bytes:
        raise Refused(f"the definition of {self._name} is not known here, so nothing could be answered in its place")


def shape_of(types: Types, name: str) -> Structure:
    """What a message consists of. Raises UnknownType."""
    return Structure(tuple(_shape(types, description) for _, description in types.fields(name)))


def _shape(types: Types, description: Any) -> Shape:
    kind, detail = description
    if kind.name == "ARRAY":
        return Array(_shape(types, detail[0]), int(detail[1]))
    if kind.name == "SEQUENCE":
        return Items(_shape(types, detail[0]), int(detail[1] or 0))
    if kind.name == "NAME":
        wide = definitions.WIDE.fullmatch(detail)
        return Text(wide=True, most=int(wide["limit"] or 0)) if wide else shape_of(types, detail)
    base = detail[0]
    return Text(most=int(detail[1] or 0)) if base == "string" else Number(_SIZES[base], base in _BOXED)
