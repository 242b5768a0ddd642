"""ROS messages without ROS: values to CDR and back, held against bytes of the C# program and of ROS."""

from __future__ import annotations

import base64
import json
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from macs_zenoh import typed
from macs_zenoh.protocol.wire import parse_frame, split_message
from macs_zenoh.typed import BadCdr, BadValue, MissingRosbags, Types, UnknownType, request_of, response_of
from tests.support.thorough import examples
from tests.unit.scripted_router import recorded


@pytest.fixture(scope="module")
def types() -> Types:
    return Types()


JPEG = base64.b64encode(bytes.fromhex("ffd8ffe000104a464946ffd9")).decode()
PUBLISHED = [
    ("std_msgs/String", {"data": "hello"}),
    ("std_msgs/String", {}),
    ("std_msgs/String", {"data": 'Grüße \u0001 "q"'}),
    ("geometry_msgs/Pose", {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"w": 1}}),
    (
        "sensor_msgs/CompressedImage",
        {"header": {"frame_id": "cam", "stamp": {"sec": 1, "nanosec": 2}}, "format": "jpeg", "data": JPEG},
    ),
]


@pytest.mark.parametrize(("row", "type_name", "value"), [(i, *row) for i, row in enumerate(PUBLISHED)])
def test_values_become_the_recorded_bytes(types: Types, row: int, type_name: str, value: dict[str, object]) -> None:
    """What the C# headset published for a value is what we write for it, and it reads back."""
    expected = bytes(parse_frame(recorded("publish", "agent->router")[row]).body)
    assert types.serialize(type_name, value) == expected
    assert types.serialize(type_name, types.deserialize(type_name, expected)) == expected


def test_recorded_services_are_read(types: Types) -> None:
    """Requests and responses of services are read, with and without CDR padding at the end."""
    _, response = split_message(recorded("call_service", "router->agent")[0])
    assert types.deserialize(response_of("std_srvs/SetBool"), response) == {"success": True, "message": "ok"}
    _, padded = split_message(recorded("serve_service", "router->agent")[1])
    assert types.deserialize(request_of("std_srvs/SetBool"), padded) == {"data": False}
    request = parse_frame(recorded("call_service", "agent->router")[0]).body
    assert types.serialize(request_of("std_srvs/SetBool"), {"data": True}) == bytes(request)


@pytest.mark.parametrize(
    ("type_name", "value"),
    [
        ("geometry_msgs/Twist", {"linear": {"x": 0.5}}),
        ("geometry_msgs/msg/Twist", {}),
        ("std_msgs/Empty", {}),
        ("std_srvs/srv/Trigger_Request", {}),
        ("sensor_msgs/LaserScan", {"ranges": [1.5, "NaN", "Infinity", "-Infinity"]}),
        ("tf2_msgs/TFMessage", {"transforms": [{"child_frame_id": "a"}, {}]}),
        ("sensor_msgs/Imu", {"orientation_covariance": [float(i) for i in range(9)]}),
        ("diagnostic_msgs/DiagnosticStatus", {"level": 2, "values": [{"key": "a", "value": "b"}]}),
        ("std_msgs/Int8MultiArray", {"data": [-128, 127]}),
        ("std_msgs/UInt64", {"data": 2**64 - 1}),
        ("sensor_msgs/JointState", {"name": ["a", "b"], "position": [1.0, 2.0]}),
    ],
)
def test_values_survive(types: Types, type_name: str, value: dict[str, object]) -> None:
    """What is written reads back: the given fields as given, the others filled; all of it is plain JSON."""
    cdr = types.serialize(type_name, value)
    back = types.deserialize(type_name, cdr)
    json.dumps(back, allow_nan=False)
    assert _contains(back, value)
    assert types.serialize(type_name, back) == cdr


def _contains(whole: object, part: object) -> bool:
    if isinstance(part, dict):
        return isinstance(whole, dict) and all(_contains(whole[key], part[key]) for key in part)
    if isinstance(part, list):
        return isinstance(whole, list) and all(_contains(*both) for both in zip(whole, part, strict=True))
    return whole == part


def test_defaults_of_the_definition_count(types: Types) -> None:
    """A pose without orientation is not turned: the definition's w is 1, as in ROS."""
    pose = types.deserialize("geometry_msgs/Pose", types.serialize("geometry_msgs/Pose", {}))
    assert pose["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def test_now_is_a_time(types: Types) -> None:
    """Where a time is wanted, "now" stands for it."""
    value = {"header": {"stamp": "now"}}
    pose = types.deserialize("geometry_msgs/PoseStamped", types.serialize("geometry_msgs/PoseStamped", value))
    assert pose["header"]["stamp"]["sec"] > 1_700_000_000


def test_bytes_come_in_three_ways(types: Types) -> None:
    """Byte arrays are taken as base64, as numbers and as bytes, and are the same then."""
    name = "sensor_msgs/CompressedImage"
    ways: list[object] = ["AAEC/w==", [0, 1, 2, 255], b"\x00\x01\x02\xff"]
    assert len({types.serialize(name, {"data": way}) for way in ways}) == 1


def test_big_arrays_are_summed_up(types: Types) -> None:
    """With a limit, longer arrays are shown by their size."""
    image = types.serialize("sensor_msgs/CompressedImage", {"data": bytes(2000)})
    assert types.deserialize("sensor_msgs/CompressedImage", image, max_bytes=1999)["data"] == {"bytes": 2000}
    assert types.deserialize("sensor_msgs/CompressedImage", image, max_bytes=2000)["data"] != {"bytes": 2000}
    scan = types.serialize("sensor_msgs/LaserScan", {"ranges": [1.0] * 100})
    assert types.deserialize("sensor_msgs/LaserScan", scan, max_bytes=256)["ranges"] == {"items": 100}


@pytest.mark.parametrize(
    ("type_name", "value", "problem"),
    [
        ("geometry_msgs/Twist", {"linear": {"q": 1}}, r"linear\.q: no such field \(there is: x, y, z\)"),
        ("geometry_msgs/Twist", {"linear": 5}, "linear: an object was expected, not 5"),
        ("geometry_msgs/Twist", {"linear": {"x": "a"}}, r"linear\.x: a float64 was expected, not 'a'"),
        ("std_msgs/UInt8", {"data": 300}, r"data: 300 is outside 0\.\.255"),
        ("std_msgs/UInt8", {"data": True}, "data: a uint8 was expected, not True"),
        ("std_msgs/UInt8", {"data": 1.0}, "data: a uint8 was expected"),
        ("std_msgs/Float32", {"data": 1e39}, r"data: 1e\+39 is outside"),
        ("std_msgs/Float64", {"data": 10**400}, "data: 1000.* is outside"),
        ("sensor_msgs/LaserScan", {"ranges": [1, -1e39]}, r"ranges\[1\]: -1e\+39 is outside"),
        ("std_msgs/String", {"data": "\ud800"}, "data: no text: surrogates"),
        ("std_msgs/Bool", {"data": 1}, "data: a bool was expected, not 1"),
        ("std_msgs/String", {"data": None}, "data: a string was expected, not None"),
        ("sensor_msgs/Imu", {"orientation_covariance": [1.0]}, "9 items are needed, not 1"),
        ("sensor_msgs/LaserScan", {"ranges": 1}, "ranges: a list was expected"),
        ("sensor_msgs/LaserScan", {"ranges": [1, None]}, r"ranges\[1\]: a float32 was expected"),
        ("sensor_msgs/CompressedImage", {"data": "?"}, "data: not base64"),
        ("std_msgs/Empty", {"x": 1}, r"x: no such field \(there is: none\)"),
    ],
)
def test_wrong_values_name_their_field(types: Types, type_name: str, value: dict[str, object], problem: str) -> None:
    """A value that does not fit is refused with the path of the field and what was wanted."""
    with pytest.raises(BadValue, match=problem):
        types.serialize(type_name, value)


@pytest.mark.parametrize(
    "cdr",
    [
        b"",
        b"\x00\x01",
        b"\x00\x01\x00\x00",
        b"\x00\x01\x00\x00\xff\xff\xff\xff",
        b"\x00\x01\x00\x00\x05\x00\x00\x00ab",
        b"\x00\x01\x00\x00\x03\x00\x00\x00\xff\xff\x00",
        b"\x06\x00\x00\x00hello\x00",  # what a headset without the ROS2 define sends: no CDR header
    ],
)
def test_bad_cdr_is_an_error(types: Types, cdr: bytes) -> None:
    """Bytes that are no message of their type are refused as such, whatever they are."""
    with pytest.raises(BadCdr, match="not a std_msgs/msg/String"):
        types.deserialize("std_msgs/String", cdr)


@pytest.mark.parametrize(
    "type_name",
    [
        "std_msgs/String",
        "sensor_msgs/PointCloud2",
        "tf2_msgs/TFMessage",
        "sensor_msgs/JointState",
        "std_srvs/srv/SetBool_Response",
    ],
)
@settings(max_examples=examples(200), deadline=None)
@given(body=st.binary(max_size=64))
def test_any_bytes_are_a_message_or_bad(types: Types, type_name: str, body: bytes) -> None:
    """Whatever a robot sends either reads as JSON or is refused as bad CDR."""
    try:
        value = types.deserialize(type_name, b"\x00\x01\x00\x00" + body)
    except BadCdr:
        return
    json.dumps(value, allow_nan=False)


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["x", "header", "data", "name"]), inner)
    ),
    max_leaves=8,
)


@pytest.mark.parametrize("type_name", ["sensor_msgs/JointState", "geometry_msgs/Twist", "std_msgs/Float32MultiArray"])
@settings(max_examples=examples(200), deadline=None)
@given(value=st.dictionaries(st.sampled_from(["header", "linear", "position", "data", "name", "layout"]), JSON_VALUES))
def test_any_value_is_written_or_refused(types: Types, type_name: str, value: dict[str, object]) -> None:
    """Whatever somebody types is either written as CDR or refused with its field."""
    try:
        cdr = types.serialize(type_name, value)
    except BadValue:
        return
    types.deserialize(type_name, cdr)


@pytest.mark.parametrize("name", ["String", "a/b/c", "std_msgs/", "std_msgs/No", "../x/Y", "std_srvs/srv/SetBool", ""])
def test_unknown_types_are_named(types: Types, name: str) -> None:
    """A type that is misspelled or not known is refused by name."""
    with pytest.raises(UnknownType, match="type"):
        types.serialize(name, {})


def test_own_definitions_are_found(tmp_path: Path) -> None:
    """Definitions in given folders are found, with those that they need, as package and as workspace."""
    package = tmp_path / "my_msgs"
    (package / "msg").mkdir(parents=True)
    (package / "srv").mkdir()
    (package / "msg" / "Spot.msg").write_text("geometry_msgs/Point at\nMark[] marks\nstring<=10 label\n")
    (package / "msg" / "Mark.msg").write_text("uint8 RED=1\nuint8[<=3] color\nfloat32[2] size\n")
    (package / "srv" / "Find.srv").write_text("# ask\nSpot near\n---\nbool found\nSpot[] spots\n")
    for folder in (tmp_path, package):
        types = Types([folder])
        value = {"spots": [{"at": {"x": 1.0}, "marks": [{"color": [1, 2]}], "label": "here"}]}
        back = types.deserialize(response_of("my_msgs/Find"), types.serialize(response_of("my_msgs/Find"), value))
        assert _contains(back["spots"][0]["at"], {"x": 1.0})
        assert back["spots"][0]["marks"] == [{"color": "AQI=", "size": [0.0, 0.0]}]
        with pytest.raises(BadValue, match="at most 3 items"):
            types.serialize("my_msgs/Mark", {"color": [1, 2, 3, 4]})


def test_broken_definitions_are_named(tmp_path: Path) -> None:
    """A definition that cannot be read, or needs one that is not there, is refused by name."""
    (tmp_path / "Broken.msg").write_text("this is !! no definition\n")
    (tmp_path / "Needy.msg").write_text("nowhere_msgs/Thing thing\n")
    (tmp_path / "Half.srv").write_text("bool data\n")
    types = Types([tmp_path])
    for name in ("x/Broken", "x/Needy", request_of("x/Half")):
        with pytest.raises(UnknownType):
            types.serialize(name, {})
    with pytest.raises(UnknownType, match="no such folder"):
        Types([tmp_path / "none"])


def test_installed_definitions_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Definitions of an installed ROS are found by its prefix path."""
    folder = tmp_path / "share" / "my_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Spot.msg").write_text("float64 x\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    types = Types()
    assert types.deserialize("my_msgs/Spot", types.serialize("my_msgs/Spot", {"x": 1})) == {"x": 1.0}


def test_services_without_a_ros_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The common services are known without any installed ROS."""
    monkeypatch.setattr(sys, "prefix", "/nowhere")
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    types = Types()
    assert types.serialize(request_of("std_srvs/SetBool"), {"data": True}) == b"\x00\x01\x00\x00\x01"
    assert types.deserialize(response_of("std_srvs/Empty"), types.serialize(response_of("std_srvs/Empty"), {})) == {}


def test_without_rosbags_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the optional package the error says how to get it."""
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(MissingRosbags, match=r"pip install 'macs-zenoh\[headset\]'"):
        typed.Types()
