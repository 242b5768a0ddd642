"""ROS messages filled from settings and from failures: field names to values, as a settings file writes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rclpy.serialization import serialize_message

from bridge.ros.side import REASON_FIELDS
from macs_zenoh.errors import Refused


def filled(kind: type[Any], values: Mapping[str, Any], what: str) -> Any:
    """A message of a type with these fields, the others zero. ``what`` names the setting in errors. Raises Refused."""
    message = kind()
    _fill(message, values, what)
    try:
        serialize_message(message)
    except Exception as error:  # the type support raises whatever its C code does
        raise Refused(f"{what} of this robot's settings does not fit {_name(message)}: {error}") from error
    return message


def failure(kind: type[Any], reason: str, values: Mapping[str, Any] | None, what: str) -> Any:
    """The response of a service that was not answered: every field zero, so ``success`` is false, and the reason
    where the type has a field for it; or what the settings say."""
    if values is not None:
        return filled(kind, values, what)
    response = kind()
    for field, field_type in response.get_fields_and_field_types().items():
        if field in REASON_FIELDS and field_type == "string":
            setattr(response, field, reason)
    return response


def _fill(message: Any, values: Mapping[str, Any], what: str) -> None:
    known = message.get_fields_and_field_types()
    for field, value in values.items():
        if field not in known:
            raise Refused(f"{what} of this robot's settings: {_name(message)} has no field {field}")
        before = getattr(message, field)
        if isinstance(value, Mapping):
            _fill(before, value, f"{what}.{field}")
            continue
        try:
            setattr(message, field, _as_python(known[field], before, value))
        except (AssertionError, TypeError, ValueError) as error:  # rclpy's setters assert
            text = f"{what}.{field} of this robot's settings: {value!r} is no {known[field]}"
            raise Refused(text) from error


def _as_python(of_type: str, before: Any, value: Any) -> Any:
    """A value of a settings file as rclpy wants it: it has no bytes there, and a whole number for a float is one."""
    if isinstance(before, float):
        return float(value)
    if "octet" in of_type:
        return [bytes([item]) for item in value] if isinstance(value, list) else bytes([value])
    return value


def _name(message: Any) -> str:
    kind = type(message)
    return f"{kind.__module__.partition('.')[0]}/{kind.__name__}"
