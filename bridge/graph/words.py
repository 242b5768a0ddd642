"""Values as people write them, YAML or JSON, and messages as they read them: YAML, one line of CSV, one field. Pure.

JSON is YAML, but for what nobody writes. Without PyYAML only JSON is read, and messages are shown as JSON.
"""

from __future__ import annotations

import csv
import importlib
import io
import json
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

from macs_zenoh.errors import MissingExtra, UsageError
from macs_zenoh.plain import plain

FieldPath = tuple[str | int, ...]
"""Names of fields and numbers of items, one inside the other."""

_STEP = re.compile(r"\.?([A-Za-z]\w*)|\[(-?\d{1,9})\]")


class MissingYaml(MissingExtra):
    """The optional package for YAML is not installed."""

    def __init__(self, what: str) -> None:
        super().__init__(what, "PyYAML", "headset")


def value_of(text: str) -> dict[str, Any]:
    """A message as somebody wrote it: ``linear: {x: 0.5}`` or ``{"linear": {"x": 0.5}}``; nothing is an empty one.

    Raises UsageError, MissingYaml for what is no JSON where YAML cannot be read.
    """
    value = _read(text)
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise UsageError(f"{_short(text)} is no message: write its fields, as 'data: 1' or '{{\"data\": 1}}'")
    return {str(name): item for name, item in value.items()}


def _read(text: str) -> Any:
    try:
        return json.loads(text, parse_float=_finite)
    except (ValueError, RecursionError):
        pass
    yaml = _yaml("a message that is no JSON")
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        problem = " ".join(str(error).split())
        raise UsageError(f"{_short(text)} is neither YAML nor JSON: {problem}") from error


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    return number


def _yaml(what: str) -> Any:
    try:
        return importlib.import_module("yaml")
    except ImportError:
        raise MissingYaml(what) from None


def as_yaml(value: Any, *, flow: bool = False) -> str:
    """A message, or a part of one, as YAML: a line for each field, or all of it in one. Raises MissingYaml."""
    yaml = _yaml("showing messages as YAML (--json does without)")
    text: str = yaml.safe_dump(value, sort_keys=False, allow_unicode=True, default_flow_style=flow, width=1 << 30)
    return text.removesuffix("...\n").rstrip("\n")


def as_csv(value: Any) -> str:
    """Every value of a message in the order of its definition, with commas between them, in one line: what would
    break it is written as an escape."""
    line = io.StringIO()
    cells = (plain(item) if isinstance(item, str) else item for item in _flat(value))
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def _flat(value: Any) -> Iterator[Any]:
    if isinstance(value, Mapping):
        for item in value.values():
            yield from _flat(item)
    elif isinstance(value, list):
        for item in value:
            yield from _flat(item)
    else:
        yield value


def field_path(text: str) -> FieldPath:
    """``pose.position.x`` or ``transforms[0].header``. Raises UsageError."""
    steps: list[str | int] = []
    at = 0
    while at < len(text):
        step = _STEP.match(text, at)
        if step is None or (not steps and text[at] == "."):
            raise UsageError(f"{_short(text)} is no field: write it as pose.position.x or transforms[0].header")
        steps.append(step[1] if step[1] is not None else int(step[2]))
        at = step.end()
    if not steps:
        raise UsageError("which field? Write it as pose.position.x or transforms[0].header")
    return tuple(steps)


def field_of(value: Any, path: FieldPath) -> Any:
    """What stands there in a message. Raises UsageError when it has no such field or item."""
    for step in path:
        if isinstance(step, int):
            if not isinstance(value, list) or not -len(value) <= step < len(value):
                raise UsageError(f"there is no item {step}")
            value = value[step]
        elif isinstance(value, Mapping) and step in value:
            value = value[step]
        else:
            known = ", ".join(map(str, value)) if isinstance(value, Mapping) else "none"
            raise UsageError(f"there is no field {step} (there is: {known})")
    return value


def _short(text: str) -> str:
    shown = repr(text)
    return shown if len(shown) <= 80 else f"{shown[:77]}..."
