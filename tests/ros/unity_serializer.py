"""How an existing headset writes and reads CDR: what Unity's serializer does to each kind of field, for the tests.

After ROS-TCP-Connector's MessageSerializer and MessageDeserializer, which existing headsets carry, in short: little
endian, aligned relative to the end of the header; a string's length counts the zero behind it; items are aligned for
whether there are any or not; a structure without fields is nothing. It reads past the end like C#: with an error.
"""

from __future__ import annotations

import importlib
import struct
from typing import Any

from rosidl_parser import definition as idl

FORMATS = {
    "boolean": "?",
    "octet": "B",
    "char": "B",
    "uint8": "B",
    "int8": "b",
    "uint16": "H",
    "int16": "h",
    "uint32": "I",
    "int32": "i",
    "uint64": "Q",
    "int64": "q",
    "float": "f",
    "double": "d",
}


def write(message: Any) -> bytes:
    """A ROS message as a headset sends it."""
    out = bytearray()
    _write_fields(out, message)
    return b"\x00\x01\x00\x00" + bytes(out)


def read(kind: type[Any], cdr: bytes) -> Any:
    """What a headset makes of it. Raises like the headset, which is deaf then."""
    reader = _Reader(cdr)
    return reader.fields(kind)


def _write_fields(out: bytearray, message: Any) -> None:
    for name, slot in zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True):
        _write(out, slot, getattr(message, name))


def _align(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)


def _write(out: bytearray, slot: Any, value: Any) -> None:
    if isinstance(slot, idl.BasicType):
        kind = FORMATS[slot.typename]
        _align(out, struct.calcsize(kind))
        out += struct.pack("<" + kind, value[0] if isinstance(value, bytes) else value)
    elif isinstance(slot, idl.AbstractGenericString):
        text = value.encode()
        _align(out, 4)
        out += struct.pack("<I", len(text) + 1) + text + b"\x00"
    elif isinstance(slot, idl.NamespacedType):
        _write_fields(out, value)
    else:
        if not isinstance(slot, idl.Array):
            _align(out, 4)
            out += struct.pack("<I", len(value))
        if isinstance(slot.value_type, idl.BasicType):
            _align(out, struct.calcsize(FORMATS[slot.value_type.typename]))
        for item in value:
            _write(out, slot.value_type, item)


class _Reader:
    def __init__(self, cdr: bytes) -> None:
        self._cdr = cdr
        self._at = 4

    def fields(self, kind: type[Any]) -> Any:
        message = kind()
        for name, slot in zip(message.get_fields_and_field_types(), kind.SLOT_TYPES, strict=True):
            setattr(message, name, self._read(slot))
        return message

    def _align(self, size: int) -> None:
        self._at += -(self._at - 4) % size

    def _take(self, count: int) -> bytes:
        begin, self._at = self._at, self._at + count
        if self._at > len(self._cdr):
            raise IndexError("offset and length were out of bounds")
        return self._cdr[begin : self._at]

    def _length(self) -> int:
        self._align(4)
        return int(struct.unpack("<i", self._take(4))[0])

    def _read(self, slot: Any) -> Any:
        if isinstance(slot, idl.BasicType):
            kind = FORMATS[slot.typename]
            self._align(struct.calcsize(kind))
            value = struct.unpack("<" + kind, self._take(struct.calcsize(kind)))[0]
            return bytes([value]) if slot.typename == "octet" else value
        if isinstance(slot, idl.AbstractGenericString):
            length = self._length()
            if length < 1:
                raise IndexError("the count of a string's bytes is negative")
            return self._take(length)[:-1].decode()
        if isinstance(slot, idl.NamespacedType):
            return self.fields(getattr(importlib.import_module(".".join(slot.namespaces)), slot.name))
        count = slot.size if isinstance(slot, idl.Array) else self._length()
        if isinstance(slot.value_type, idl.BasicType):
            self._align(struct.calcsize(FORMATS[slot.value_type.typename]))
            self._take(0)
        return [self._read(slot.value_type) for _ in range(count)]
