"""ROS messages without ROS: CDR bytes to Python values and back, through `rosbags` (ROS 2 Jazzy's definitions).

Values are what JSON has: objects, lists, numbers, strings. A type is named ``pkg/Name`` (or ``pkg/msg/Name``), a
service's two halves by `request_of` and `response_of`. Writing takes partial objects and fills what is missing with
the definition's defaults. Beyond plain JSON:

* bytes (``uint8[]``, ``byte[]``) are a base64 string, or ``{"bytes": n}`` for a summary; writing takes base64, a
  list of numbers, or bytes
* numbers that JSON lacks are the strings ``"NaN"``, ``"Infinity"`` and ``"-Infinity"``
* ``"now"`` stands for the present time where a ``builtin_interfaces/Time`` is wanted

Types that rosbags does not bring are read from ``.msg``, ``.srv`` and ``.action`` files: in the given folders, then in
the installed ROS (``AMENT_PREFIX_PATH``, and this Python's own prefix).
"""

from __future__ import annotations

import base64
import binascii
import importlib
import keyword
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from . import definitions
from .errors import MissingExtra, UsageError, WireError

MESSAGE_TYPE_PARTS = 3  # pkg, msg, Name

_DEFAULTS: dict[tuple[str, str], object] = {
    ("geometry_msgs/msg/Quaternion", "w"): 1.0,
    ("sensor_msgs/msg/NavSatStatus", "status"): -2,
}
"""Defaults that are not zero in the definitions that rosbags brings; it does not keep them."""

_FILLER = "structure_needs_at_least_one_member"
_TIME = "builtin_interfaces/msg/Time"
_INTEGER_RANGE = {
    f"{sign}int{bits}": (0, (1 << bits) - 1) if sign else (-(1 << bits - 1), (1 << bits - 1) - 1)
    for sign in ("", "u")
    for bits in (8, 16, 32, 64)
} | {"byte": (0, 255), "char": (0, 255)}
_FLOAT_LIMIT = {"float32": 3.4028234663852886e38, "float64": sys.float_info.max}
_BYTE_TYPES = {"uint8": "uint8", "byte": "uint8", "char": "uint8"}
_LARGE = frozenset({"int64", "uint64", "float64"})
_SLACK_BYTES = 4 + 3
_NON_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


class MissingRosbags(MissingExtra):
    """The optional package for typed messages is not installed."""

    def __init__(self) -> None:
        super().__init__("reading and writing messages", "rosbags", "headset")


class UnknownType(UsageError):
    """No definition was found for a type."""

    def __init__(self, name: str, why: str = "no definition found (give its folder, or install its package)") -> None:
        super().__init__(f"type {name!r}: {why}")
        self.name = name
        self.why = why


class BadValue(UsageError):
    """A value does not fit its type. ``path`` names the field, as ``linear.x``."""

    def __init__(self, type_name: str, path: str, problem: str) -> None:
        super().__init__(f"{type_name}{': ' if path else ''}{path}: {problem}")
        self.type_name = type_name
        self.path = path
        self.problem = problem


class BadCdr(WireError):
    """Bytes that are not a message of their type."""

    def __init__(self, type_name: str, problem: str) -> None:
        super().__init__(f"not a {type_name}: {problem}")
        self.type_name = type_name
        self.problem = problem


PARTS = {"srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
"""What the definitions of services and actions consist of, in their order."""


def part_of_action(action: str, part: str) -> str:
    """The type of an action's Goal, Result or Feedback: ``demo_msgs/Turn`` → ``demo_msgs/action/Turn_Goal``."""
    package, name = _package_and_name(action)
    return f"{package}/action/{name}_{part}"


def request_of(service: str) -> str:
    """The type of a service's request: ``std_srvs/SetBool`` → ``std_srvs/srv/SetBool_Request``."""
    package, name = _package_and_name(service)
    return f"{package}/srv/{name}_Request"


def response_of(service: str) -> str:
    """The type of a service's response: ``std_srvs/SetBool`` → ``std_srvs/srv/SetBool_Response``."""
    package, name = _package_and_name(service)
    return f"{package}/srv/{name}_Response"


class Types:
    """A store of message definitions. Finding and compiling a type is done once; making a store takes 60 ms."""

    def __init__(self, definitions: Sequence[str | Path] = ()) -> None:
        """``definitions``: folders to search for ``.msg``, ``.srv`` and ``.action`` files.

        Raises MissingRosbags, UnknownType.
        """
        try:
            self._typesys: Any = importlib.import_module("rosbags.typesys")
            self._serde_error: Any = importlib.import_module("rosbags.serde.errors").SerdeError
            self._kinds: Any = importlib.import_module("rosbags.interfaces").Nodetype
            self._numpy: Any = importlib.import_module("numpy")
        except ImportError as error:
            raise MissingRosbags from error
        self._store: Any = self._typesys.get_typestore(self._typesys.Stores.ROS2_JAZZY)
        self._defaults: dict[tuple[str, str], Any] = dict(_DEFAULTS)
        self._slack: dict[str, bool] = {}
        self._folders = [Path(folder) for folder in definitions]
        for folder in self._folders:
            if not folder.is_dir():
                raise UnknownType(str(folder), "no such folder")

    def serialize(self, type_name: str, value: Mapping[str, object]) -> bytes:
        """CDR of a message; missing fields get their defaults. Raises BadValue with the field's path, UnknownType."""
        name = self._known(type_name)
        message = self._build(name, value, "")
        try:
            return bytes(self._store.serialize_cdr(message, name))
        except self._serde_error as error:
            raise BadValue(name, "", str(error)) from error

    def deserialize(
        self, type_name: str, cdr: bytes | bytearray | memoryview, *, max_bytes: int | None = None
    ) -> dict[str, Any]:
        """A message as a JSON-able object. Raises BadCdr, UnknownType.

        With ``max_bytes``, longer byte arrays become ``{"bytes": n}`` and numeric arrays of more bytes
        ``{"items": n}``.
        """
        name = self._known(type_name)
        try:
            message = self._store.deserialize_cdr(self._trimmed(name, cdr), name)
        except (self._serde_error, MemoryError) as error:
            raise BadCdr(name, str(error)) from error
        return self._plain_message(name, message, max_bytes)

    def fields(self, type_name: str) -> Sequence[tuple[str, Any]]:
        """A type's fields in their order, as `rosbags` has them. Raises UnknownType."""
        name = self._known(type_name)
        return [field for field in self._store.fielddefs[name][1] if field[0] != _FILLER]

    def add(self, type_name: str, text: str) -> None:
        """Know a message, or a part of a service or action, by its definition. Raises UnknownType."""
        package, short, _ = _parse(type_name)
        self._register(f"{package}/msg/{short}", text)

    def _trimmed(self, name: str, cdr: bytes | bytearray | memoryview) -> bytes | bytearray | memoryview:
        """Without what rclpy leaves behind a message of some types, for which it asks for more room than they take."""
        if len(cdr) <= _SLACK_BYTES or bytes(cdr[:2]) != b"\x00\x01" or not self._may_have_slack(name):
            return cdr
        msgdef = self._store.get_msgdef(name)
        try:
            _, end = msgdef.deserialize_cdr_le(cdr[4:], 0, msgdef.cls, self._store)
        except Exception:  # noqa: BLE001 - generated code; what is wrong with it is said by who calls
            return cdr
        return cdr[: 4 + end]

    def _may_have_slack(self, name: str) -> bool:
        found = self._slack.get(name)
        if found is None:
            fields = self._store.fielddefs[name][1]
            found = self._slack[name] = any(self._field_has_slack(description) for _, description in fields)
        return found

    def _field_has_slack(self, description: Any) -> bool:
        kind, detail = description
        if kind == self._kinds.NAME:
            return definitions.WIDE.fullmatch(detail) is not None or self._may_have_slack(detail)
        if kind == self._kinds.BASE:
            return False
        (item_kind, item), _ = detail
        if item_kind == self._kinds.BASE:
            return bool(kind == self._kinds.SEQUENCE and item[0] in _LARGE)
        return self._field_has_slack((item_kind, item))

    # --- definitions ---

    def _known(self, type_name: str) -> str:
        """The type's name in the store, its definition and those that it needs loaded."""
        package, short, part_of = _parse(type_name)
        name = f"{package}/msg/{short}"
        if name in self._store.fielddefs:
            return name
        if part_of:
            self._load_parts(package, part_of, short.rpartition("_")[0])
        else:
            self._load_message(package, short)
        if name not in self._store.fielddefs:
            raise UnknownType(type_name)
        return name

    def _load_message(self, package: str, name: str) -> None:
        path = self._find(package, "msg", name)
        if path is None:
            raise UnknownType(f"{package}/{name}")
        self._register(f"{package}/msg/{name}", path.read_text(encoding="utf-8"))

    def _load_parts(self, package: str, kind: str, name: str) -> None:
        """The messages that a service or an action consists of."""
        path = self._find(package, kind, name)
        text = path.read_text(encoding="utf-8") if path else definitions.SERVICES.get(f"{package}/{name}")
        if text is None:
            raise UnknownType(f"{package}/{name}")
        parts = [[]]  # type: list[list[str]]
        for line in text.splitlines():
            if line.strip() == "---":
                parts.append([])
            else:
                parts[-1].append(line)
        if len(parts) != len(PARTS[kind]):
            raise UnknownType(f"{package}/{name}", f"its definition is no {'service' if kind == 'srv' else kind}")
        for part, lines in zip(PARTS[kind], parts, strict=True):
            self._register(f"{package}/msg/{name}_{part}", "\n".join(lines))

    def _register(self, name: str, text: str) -> None:
        try:
            definition = definitions.read(text)
            for wide in definition.wide:
                self._register_wide(wide)
            found = self._typesys.get_types_from_msg(definition.text, name)
        except (self._typesys.TypesysError, definitions.BadDefinition) as error:
            raise UnknownType(name, str(error)) from error
        for _, fields in found.values():
            for _, description in fields:
                self._load_needed(description)
        self._store.register(found)
        fields = dict(self._store.fielddefs[name][1])
        for field, value in definition.defaults.items():
            try:
                self._defaults[name, field] = self._build_any(fields[field], value, field)
            except BadValue as error:
                raise UnknownType(name, f"the default of {field}: {error}") from error

    def _register_wide(self, name: str) -> None:
        name = f"{definitions.WIDE_PACKAGE}/msg/{name}"
        if name not in self._store.fielddefs:
            self._store.register(self._typesys.get_types_from_msg("uint32[] units", name))

    def _load_needed(self, description: Any) -> None:
        kind, detail = description
        if kind in (self._kinds.ARRAY, self._kinds.SEQUENCE):
            self._load_needed(detail[0])
        elif kind == self._kinds.NAME:
            self._known(detail)

    def _find(self, package: str, kind: str, name: str) -> Path | None:
        prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
        prefixes.append(Path(sys.prefix))
        file_name = f"{name}.{kind}"
        places = [place / file_name for folder in self._folders for place in _places(folder, package, kind)]
        places += [prefix / "share" / package / kind / file_name for prefix in prefixes]
        return next((place for place in places if place.is_file()), None)

    # --- Python value -> message ---

    def _build(self, name: str, value: object, path: str) -> Any:
        if name == _TIME and value == "now":
            nanoseconds = time.time_ns()
            value = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
        if (wide := definitions.WIDE.fullmatch(name)) is not None:
            return self._build_wide(name, int(wide["limit"] or 0), value, path)
        if not isinstance(value, Mapping):
            raise BadValue(name, path, f"an object was expected, not {_shown(value)}")
        fields = dict(self._store.fielddefs[name][1])
        for key in value:
            if key not in fields:
                known = ", ".join(field for field in fields if field != _FILLER) or "none"
                raise BadValue(name, _join(path, str(key)), f"no such field (there is: {known})")
        filled = {
            field: self._build_field(name, field, description, value, _join(path, field))
            for field, description in fields.items()
        }
        if not fields:  # the store adds this field to an empty definition only in the class
            filled[_FILLER] = 0
        return self._store.types[name](**{_attribute(field): item for field, item in filled.items()})

    def _build_wide(self, name: str, limit: int, value: object, path: str) -> Any:
        if not isinstance(value, str):
            raise BadValue("wstring", path, f"a wstring was expected, not {_shown(value)}")
        try:
            units = definitions.units_of(value)
        except UnicodeEncodeError as error:
            raise BadValue("wstring", path, f"no text: {error.reason}") from error
        if limit and len(units) > limit:
            raise BadValue("wstring", path, f"at most {limit} UTF-16 units are allowed, not {len(units)}")
        return self._store.types[name](units=self._array("uint32", units))

    def _build_field(self, name: str, field: str, description: Any, value: Mapping[str, object], path: str) -> Any:
        if field in value:
            return self._build_any(description, value[field], path)
        if (name, field) in self._defaults:
            return self._defaults[name, field]
        return self._default(description, path)

    def _build_any(self, description: Any, value: object, path: str) -> Any:
        kind, detail = description
        if kind == self._kinds.BASE:
            return _base(detail[0], value, path, detail[1])
        if kind == self._kinds.NAME:
            return self._build(detail, value, path)
        return self._build_items(kind == self._kinds.ARRAY, detail, value, path)

    def _build_items(self, fixed: bool, detail: Any, value: object, path: str) -> Any:
        (kind, item), length = detail
        base = item[0] if kind == self._kinds.BASE else ""
        items: Any = value
        if base in _BYTE_TYPES and isinstance(value, str | bytes | bytearray):
            items = self._numpy.frombuffer(_bytes(value, path), dtype="uint8")
        elif not isinstance(value, list | tuple):
            raise BadValue(base or "list", path, f"a list was expected, not {_shown(value)}")
        if fixed and len(items) != length:
            raise BadValue(base or "list", path, f"{length} items are needed, not {len(items)}")
        if not fixed and length and len(items) > length:
            raise BadValue(base or "list", path, f"at most {length} items are allowed, not {len(items)}")
        if items is not value:
            return items
        built = [self._build_any((kind, item), one, f"{path}[{i}]") for i, one in enumerate(items)]
        return built if base in ("", "string") else self._array(base, built)

    def _default(self, description: Any, path: str) -> Any:
        kind, detail = description
        if kind == self._kinds.BASE:
            return _zero(detail[0])
        if kind == self._kinds.NAME:
            return self._build(detail, "" if definitions.WIDE.fullmatch(detail) else {}, path)
        (item_kind, item), length = detail
        count = length if kind == self._kinds.ARRAY else 0
        items = [self._default((item_kind, item), path) for _ in range(count)]
        return self._array(item[0], items) if item_kind == self._kinds.BASE and item[0] != "string" else items

    def _array(self, base: str, items: list[Any]) -> Any:
        if base == "byte":
            items = [item & 0xFF for item in items]
        return self._numpy.array(items, dtype=_BYTE_TYPES.get(base, base))

    # --- message -> Python value ---

    def _plain_message(self, name: str, message: Any, max_bytes: int | None) -> dict[str, Any]:
        return {
            field: self._plain(description, getattr(message, _attribute(field)), max_bytes)
            for field, description in self._store.fielddefs[name][1]
            if field != _FILLER
        }

    def _plain(self, description: Any, value: Any, max_bytes: int | None) -> Any:
        kind, detail = description
        if kind == self._kinds.BASE:
            return _plain_base(detail[0], value)
        if kind == self._kinds.NAME and definitions.WIDE.fullmatch(detail):
            return definitions.text_of(value.units)
        if kind == self._kinds.NAME:
            return self._plain_message(detail, value, max_bytes)
        (item_kind, item), _ = detail
        if item_kind == self._kinds.BASE and item[0] != "string":
            return self._plain_array(item[0], value, max_bytes)
        return [self._plain((item_kind, item), one, max_bytes) for one in value]

    def _plain_array(self, base: str, value: Any, max_bytes: int | None) -> Any:
        array = self._numpy.asarray(value)
        is_bytes = base in _BYTE_TYPES
        if max_bytes is not None and array.nbytes > max_bytes:
            return {"bytes" if is_bytes else "items": len(array)}
        if is_bytes:
            return base64.b64encode(array.tobytes()).decode("ascii")
        items = array.tolist()
        return [_finite(item) for item in items] if base.startswith("float") else items


def _places(folder: Path, package: str, kind: str) -> list[Path]:
    """Where a folder may hold a package's definitions: it is a workspace, a package, or just holds files."""
    inside = [folder / package / kind]
    if folder.name == package:
        inside.append(folder / kind)
    return [*inside, folder]


def _parse(type_name: str) -> tuple[str, str, str]:
    """Package, name, and of what it is a part: ``srv``, ``action`` or nothing. Raises UnknownType."""
    parts, part_of = type_name.split("/"), ""
    if len(parts) == MESSAGE_TYPE_PARTS and parts[1] in ("msg", *PARTS):
        part_of = parts[1] if parts[1] in PARTS else ""
        if part_of and not parts[2].endswith(tuple(f"_{part}" for part in PARTS[part_of])):
            raise UnknownType(type_name, f"{'a service' if part_of == 'srv' else 'an action'} is no message")
        parts = [parts[0], parts[2]]
    if len(parts) != 2 or not all(part.replace("_", "").isalnum() and part.isascii() for part in parts):
        raise UnknownType(type_name, "write it as pkg/Name")
    return parts[0], parts[1], part_of


def _package_and_name(service: str) -> tuple[str, str]:
    package, name, _ = _parse(service.replace("/srv/", "/").replace("/action/", "/"))
    return package, name


def _base(base: str, value: object, path: str, limit: int = 0) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if base == "string" and isinstance(value, str):
        return _string(value, path, limit)
    if base == "bool" and isinstance(value, bool):
        return value
    if base in _INTEGER_RANGE and is_number and isinstance(value, int):
        low, high = _INTEGER_RANGE[base]
        if not low <= value <= high:
            raise BadValue(base, path, f"{_shown(value)} is outside {low}..{high}")
        return value - 256 if base == "byte" and value > 127 else value  # rosbags writes a byte with its sign
    if base in _FLOAT_LIMIT and is_number:
        return _float(base, value, path)
    if base in _FLOAT_LIMIT and isinstance(value, str) and value in _NON_FINITE:
        return _NON_FINITE[value]
    raise BadValue(base, path, f"a {base} was expected, not {_shown(value)}")


def _string(value: str, path: str, limit: int) -> str:
    try:
        size = len(value.encode())
    except UnicodeEncodeError as error:  # JSON can spell half a character
        raise BadValue("string", path, f"no text: {error.reason}") from error
    if limit and size > limit:
        raise BadValue("string", path, f"at most {limit} bytes are allowed, not {size}")
    if "\0" in value:
        raise BadValue("string", path, "ROS ends a text at its first zero character")
    return value


def _float(base: str, value: Any, path: str) -> float:
    limit = _FLOAT_LIMIT[base]
    if not (-limit <= value <= limit or (isinstance(value, float) and not math.isfinite(value))):
        raise BadValue(base, path, f"{_shown(value)} is outside {-limit:g}..{limit:g}")
    return float(value)


def _attribute(field: str) -> str:
    """The field's name in Python, as rosbags has it."""
    return f"{field}_" if keyword.iskeyword(field) else field


def _plain_base(base: str, value: Any) -> Any:
    if base.startswith("float"):
        return _finite(value)
    return value & 0xFF if base == "byte" else value


def _zero(base: str) -> Any:
    return "" if base == "string" else False if base == "bool" else 0.0 if base.startswith("float") else 0


def _bytes(value: str | bytes | bytearray, path: str) -> bytes:
    if not isinstance(value, str):
        return bytes(value)
    try:
        return base64.b64decode(value, validate=True)
    except binascii.Error as error:
        raise BadValue("uint8", path, f"not base64: {error}") from error


def _finite(value: Any) -> Any:
    """The number, or its name where JSON has no such number."""
    number = float(value)
    if math.isfinite(number):
        return number
    return "NaN" if math.isnan(number) else "Infinity" if number > 0 else "-Infinity"


def _join(path: str, field: str) -> str:
    return f"{path}.{field}" if path else field


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
