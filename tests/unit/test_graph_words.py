"""Values as people write them, and messages as they read them."""

from __future__ import annotations

import math
import sys

import pytest

from bridge.graph.words import MissingYaml, as_csv, as_yaml, field_of, field_path, value_of
from macs_zenoh.errors import UsageError


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", {}),
        ("{}", {}),
        ('{"data": "hello"}', {"data": "hello"}),
        ("data: hello", {"data": "hello"}),
        ("linear: {x: 0.5}\nangular: {z: -1}", {"linear": {"x": 0.5}, "angular": {"z": -1}}),
        ("{data: [1, 2]}", {"data": [1, 2]}),
        ('{"data": "NaN"}', {"data": "NaN"}),
        ("data: .inf", {"data": math.inf}),
    ],
)
def test_a_message_is_written_as_yaml_or_json(text: str, value: dict[str, object]) -> None:
    """Both ways of ros2cli's users mean the same."""
    assert value_of(text) == value


@pytest.mark.parametrize("text", ["3", "[1]", "hello", "a: b: c", "{" * 5000, "!!python/object:os.system {}", "1e999"])
def test_what_is_no_message_is_told(text: str) -> None:
    """In one line that shows the beginning of it."""
    with pytest.raises(UsageError) as told:
        value_of(text)
    assert "\n" not in str(told.value)


def test_without_yaml_json_still_works(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever has not installed PyYAML is told which extra brings it, when it is needed."""
    monkeypatch.setitem(sys.modules, "yaml", None)
    assert value_of('{"data": 1}') == {"data": 1}
    with pytest.raises(MissingYaml, match="headset"):
        value_of("data: 1")
    with pytest.raises(MissingYaml, match="--json"):
        as_yaml({"data": 1})


def test_messages_are_shown_as_ros2cli_does() -> None:
    """Fields in their order, below each other or in one line, or values with commas."""
    message = {"header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": ""}, "data": [1.5, "a,b"], "is_on": True}
    header = "header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: ''\n"
    assert as_yaml(message) == header + "data:\n- 1.5\n- a,b\nis_on: true"
    assert as_yaml(message["data"], flow=True) == "[1.5, 'a,b']"
    assert as_yaml(2.5) == "2.5"
    assert as_csv(message) == '1,2,,1.5,"a,b",True'


def test_what_others_say_stays_in_its_line() -> None:
    """A message that is one line is one, whatever is in it: programs and people take the next one for another's."""
    hostile = {"data": "x\n---\n# robot 8\rdata: 1\u2028\x1b[2J\x85y"}
    for line in (as_csv(hostile), as_csv("a\nb"), as_yaml(hostile, flow=True)):
        assert len(line.splitlines()) == 1, line
    for said in (hostile, hostile["data"], [hostile["data"]]):
        for line in as_yaml(said).splitlines()[1:]:
            assert line[:1] in ("", " "), line


def test_one_field_is_found_by_its_path() -> None:
    """Fields inside fields, items of lists, and in one line what there is instead of a wrong one."""
    message = {"transforms": [{"header": {"frame_id": "odom"}}, {}]}
    assert field_of(message, field_path("transforms[0].header.frame_id")) == "odom"
    assert field_of(message, field_path("transforms[-1]")) == {}
    with pytest.raises(UsageError, match="there is: frame_id"):
        field_of(message, field_path("transforms[0].header.frame"))
    with pytest.raises(UsageError, match="no item 2"):
        field_of(message, field_path("transforms[2]"))
    for wrong in ("", ".x", "x..y", "x[", "x y", "x[99999999999]"):
        with pytest.raises(UsageError, match="field"):
            field_path(wrong)
