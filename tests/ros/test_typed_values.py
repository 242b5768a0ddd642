"""Each base type at its limits, as JSON and as rclpy has it, both ways; and defaults, as ROS fills them in."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from bridge.headset.verbs import json_object
from bridge.ros.fields import filled
from macs_zenoh.errors import Refused, UsageError
from macs_zenoh.typed import BadCdr, BadValue, Types, UnknownType
from tests.ros.test_types import _installed

pytestmark = pytest.mark.timeout(600)  # the first of them compiles its messages, on a busy machine for minutes

KINDS = Path(__file__).parent / "macs_kinds_msgs"
NAME = "macs_kinds_msgs/Kinds"


@pytest.fixture(scope="module")
def types() -> Types:
    return Types([KINDS])


def ints(bits: int, *, signed: bool) -> list[int]:
    return [-(1 << bits - 1), -1, 0, (1 << bits - 1) - 1] if signed else [0, 1, (1 << bits) - 1]


FLOAT32 = [0.0, -0.0, 3.4028234663852886e38, -3.4028234663852886e38, 1.401298464324817e-45]
FLOAT64 = [0.0, 1.7976931348623157e308, -1.7976931348623157e308, 5e-324, 0.1, 1e22]
LIMITS: list[tuple[str, list[Any]]] = [
    ("truth", [False, True]),
    ("octet", [0, 127, 128, 200, 255]),
    ("letter", [0, 127, 128, 255]),
    *((f"i{bits}", ints(bits, signed=True)) for bits in (8, 16, 32, 64)),
    *((f"u{bits}", ints(bits, signed=False)) for bits in (8, 16, 32, 64)),
    ("f32", FLOAT32),
    ("f64", FLOAT64),
    ("text", ["", "a", "Grüße 😀", "\u0001\n\x7f"]),
    ("short_text", ["", "12345678"]),
    ("wide", ["", "a", "hé😀", "\uffff"]),
    ("short_wide", ["é😀", "abcd"]),
    ("doubles", [[], FLOAT64]),
    ("floats", [[], FLOAT32]),
    ("longs", [[], ints(64, signed=True)]),
    ("few_longs", [[], ints(64, signed=False)]),
    ("shorts", [[], ints(16, signed=True)]),
    ("truths", [[], [True, False]]),
    ("texts", [[], ["", "é"]]),
    ("wides", [[], ["", "é", "😀"]]),
    ("three_truths", [[True, False, True]]),
    ("three_doubles", [[0.5, -1.0, 2.0]]),
    ("two_texts", [["x", ""]]),
]


def plain(value: Any) -> Any:
    """rclpy's value of a field as JSON has it."""
    if isinstance(value, bytes):
        return value[0]
    if isinstance(value, bool | int | float | str):
        return value
    return [plain(item) for item in value]


@pytest.mark.parametrize(("field", "values"), LIMITS, ids=[field for field, _ in LIMITS])
def test_each_base_type_at_its_limits(types: Types, kinds: Any, field: str, values: list[Any]) -> None:
    """What JSON says is what rclpy has, to the last bit, and what rclpy has is what JSON says."""
    for value in values:
        said = json_object(json.dumps({field: value}))
        message = deserialize_message(types.serialize(NAME, said), kinds.Kinds)
        assert plain(getattr(message, field)) == value
        back = types.deserialize(NAME, bytes(serialize_message(message)))
        assert back[field] == value
        if isinstance(value, float):
            assert math.copysign(1, getattr(message, field)) == math.copysign(1, value)


@pytest.mark.parametrize("field", ["octets", "letters", "data"])
def test_bytes_at_their_limits(types: Types, kinds: Any, field: str) -> None:
    """Sequences of bytes are base64, or a list of numbers, of all 256 values."""
    every = bytes(range(256))
    for value in (base64.b64encode(every).decode(), list(every)):
        message = deserialize_message(types.serialize(NAME, {field: value}), kinds.Kinds)
        assert bytes(plain(getattr(message, field))) == every
        assert base64.b64decode(types.deserialize(NAME, bytes(serialize_message(message)))[field]) == every


@pytest.mark.parametrize(
    ("field", "text"),
    [
        ("f64", "1e400"), ("f64", "-1e400"), ("f32", "1e39"), ("f32", "3.5e38"), ("octet", "256"), ("octet", "-1"),
        ("i8", "128"), ("i64", "9223372036854775808"), ("u64", "-1"), ("u8", "1.0"), ("u8", "true"), ("truth", "1"),
        ("text", "5"), ("wide", "5"), ("wide", '"\\ud800"'), ("text", '"\\ud800"'), ("text", '"a\\u0000b"'),
        ("short_text", '"123456789"'), ("short_wide", '"abc😀"'), ("few_longs", "[1, 2, 3, 4]"),
        ("three_doubles", "[1, 2]"), ("doubles", "[1e400]"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_told(types: Types, field: str, text: str) -> None:
    """A value outside its type is an error that names the field or the number, never another value."""
    with pytest.raises((BadValue, UsageError), match=f"{field}|too large"):
        types.serialize(NAME, json_object(f'{{"{field}": {text}}}'))


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity"])
def test_numbers_that_json_lacks_are_said_in_words(types: Types, kinds: Any, text: str) -> None:
    """Who means infinity says so."""
    message = deserialize_message(types.serialize(NAME, {"f64": text, "f32": text}), kinds.Kinds)
    assert str(message.f64) == str(float(text))
    assert types.deserialize(NAME, bytes(serialize_message(message)))["f32"] == text


def test_fields_left_out_have_their_defaults(types: Types, kinds: Any) -> None:
    """The defaults of a definition are those that ROS fills in, alone and inside of another message."""
    message = deserialize_message(types.serialize("macs_kinds_msgs/Defaults", {}), kinds.Defaults)
    assert message == kinds.Defaults()
    assert message.gain == 1.5
    assert message.name == "a 'name'"
    message = deserialize_message(types.serialize("macs_kinds_msgs/Defaults", {"gain": 2, "level": 0}), kinds.Defaults)
    assert (message.gain, message.level, message.count) == (2, 0, -7)


def test_every_installed_type_has_the_defaults_that_ros_has(types: Types) -> None:
    """An empty object is rclpy's new message, for each type that is installed here."""
    compared = 0
    for name, kind in _installed():
        try:
            cdr = types.serialize(name, {})
        except UnknownType:
            continue
        assert deserialize_message(cdr, kind) == kind(), name
        compared += 1
    assert compared > 100


def test_a_level_reads_as_ros_has_it(types: Types) -> None:
    """A byte of a type that everybody has: 255 and 200 are 255 and 200."""
    for level in (0, 2, 200, 255):
        cdr = types.serialize("diagnostic_msgs/DiagnosticStatus", {"level": level})
        assert deserialize_message(cdr, DiagnosticStatus).level == bytes([level])
        assert types.deserialize("diagnostic_msgs/DiagnosticStatus", cdr)["level"] == level


def test_a_byte_in_a_robots_settings(kinds: Any) -> None:
    """Settings have no bytes, so a number stands for one, and one that is none is told."""
    message = filled(kinds.Kinds, {"octet": 200, "octets": [0, 255]}, "deadman_message")
    assert (message.octet, message.octets) == (b"\xc8", [b"\x00", b"\xff"])
    for wrong in (256, -1):
        with pytest.raises(Refused, match="is no octet"):
            filled(kinds.Kinds, {"octet": wrong}, "deadman_message")


@pytest.mark.parametrize("default", ["[1, 2", "300000000000", '"half', "one"])
def test_a_default_that_is_none_is_told(tmp_path: Path, default: str) -> None:
    """A definition whose default cannot be read is named, with the field."""
    (tmp_path / "Odd.msg").write_text(f"int32 count {default}\n")
    with pytest.raises(UnknownType, match=r"Odd.*count"):
        Types([tmp_path]).serialize("own_msgs/Odd", {})


def test_wide_text_that_is_cut_is_no_message(types: Types) -> None:
    """Bytes that end inside of a wstring are told."""
    cdr = types.serialize(NAME, {})
    with pytest.raises(BadCdr):
        types.deserialize(NAME, cdr[:90])


def test_a_field_may_have_a_name_that_python_uses(tmp_path: Path) -> None:
    """`from` and `class` are fields like others; Python's words are no concern of a headset."""
    (tmp_path / "Odd.msg").write_text("int32 from\nint32 class 5\nInner[] other\nfloat64[] doubles\n")
    (tmp_path / "Inner.msg").write_text("string in\n")
    types, value = Types([tmp_path]), {"from": 3, "class": 5, "other": [{"in": "a"}], "doubles": []}
    cdr = types.serialize("own_msgs/Odd", {"from": 3, "other": [{"in": "a"}]})
    assert types.deserialize("own_msgs/Odd", cdr) == value


def test_what_rclpy_leaves_behind_a_message_is_no_part_of_it(types: Types) -> None:
    """A service's answer may be longer than its message; a message of another type is told all the same."""
    state = JointState(name=["a"], position=[1.0])
    cdr = bytes(serialize_message(state))
    for data in (cdr, cdr + bytes(64)):
        assert types.deserialize("sensor_msgs/JointState", data)["position"] == [1.0]
    with pytest.raises(BadCdr):
        types.deserialize("std_msgs/Bool", cdr)
