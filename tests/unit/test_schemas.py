"""Definitions of types, and the schemas made of them."""

from __future__ import annotations

import pytest

from macs_zenoh import robot_types
from macs_zenoh.protocol.messages import decode_data, encode_data
from macs_zenoh.protocol.schemas import (
    SCHEMA_BYTES,
    TEXT_BYTES,
    Definition,
    DefinitionsReply,
    DefinitionsRequest,
    definitions_in,
    full_type,
    needs,
    schema,
    text_of,
)

POSE = "# where it is\nPoint position  # [m]\nQuaternion orientation\n"
POINT = "float64 x\nfloat64 y\nfloat64 z\n"
QUATERNION = "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
STAMPED = "std_msgs/Header header\nPose pose\n"
HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
TIME = "int32 sec\nuint32 nanosec\n"
KNOWN = {
    "geometry_msgs/msg/PoseStamped": Definition(STAMPED),
    "geometry_msgs/msg/Pose": Definition(POSE),
    "geometry_msgs/msg/Point": Definition(POINT),
    "geometry_msgs/msg/Quaternion": Definition(QUATERNION),
    "std_msgs/msg/Header": Definition(HEADER),
    "builtin_interfaces/msg/Time": Definition(TIME),
    "a_msgs/srv/Ask": Definition("string what\n---\nstd_msgs/Header said\n"),
    "a_msgs/action/Go": Definition("float64 far\n---\nbool there\n---\nfloat64 left\n"),
}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", []),
        ("# Pose pose\n", []),
        ("Pose pose # of it", ["a_msgs/msg/Pose"]),
        ("Header header", ["std_msgs/msg/Header"]),
        ("b_msgs/Pose[] poses\nb_msgs/msg/Pose one", ["b_msgs/msg/Pose"]),
        ("Few[<=3] few\nTwo[2] two\n\tThree three\r\n", ["a_msgs/msg/Few", "a_msgs/msg/Two", "a_msgs/msg/Three"]),
        ("string<=8[<=2] names\nwstring<=4 wide\nuint8[] data\nint32 X=5\nstring s 'Pose pose'", []),
        ("not a definition at all; {}\n\x00\n", ["a_msgs/msg/not"]),
    ],
)
def test_what_a_definition_needs(text: str, found: list[str]) -> None:
    """The types of fields, by full name, each once; not what is in comments, constants and defaults."""
    assert needs("a_msgs/msg/Any", text) == found


def test_a_schema_has_all_that_a_type_needs_once() -> None:
    """The type's own text, then each other type behind a line of 80 =, the nearest first."""
    rule = "=" * 80
    assert schema("geometry_msgs/msg/PoseStamped", KNOWN) == (
        f"{STAMPED}{rule}\nMSG: std_msgs/Header\n{HEADER}{rule}\nMSG: geometry_msgs/Pose\n{POSE}"
        f"{rule}\nMSG: builtin_interfaces/Time\n{TIME}{rule}\nMSG: geometry_msgs/Point\n{POINT}"
        f"{rule}\nMSG: geometry_msgs/Quaternion\n{QUATERNION}"
    )


def test_parts_of_services_and_actions_have_schemas() -> None:
    """Requests, responses, goals, results and feedback are messages, by the names that ROS gives them."""
    assert schema("a_msgs/srv/Ask_Request", KNOWN) == "string what\n"
    response = schema("a_msgs/srv/Ask_Response", KNOWN)
    assert response is not None
    assert response.startswith("std_msgs/Header said\n====")
    assert schema("a_msgs/action/Go_Feedback", KNOWN) == "float64 left\n"
    for name in ("a_msgs/srv/Ask", "a_msgs/srv/Ask_Goal", "a_msgs/action/Go", "a_msgs/srv/None_Request", "x", ""):
        assert text_of(name, KNOWN) is None, name


def test_a_schema_is_whole_or_none() -> None:
    """Where the text of one needed type is not known, there is no schema: half of one would be read wrongly."""
    less = {name: text for name, text in KNOWN.items() if name != "geometry_msgs/msg/Point"}
    assert schema("geometry_msgs/msg/PoseStamped", less) is None
    assert schema("geometry_msgs/msg/Unknown", KNOWN) is None


def test_types_that_need_each_other_end() -> None:
    """A robot may tell nonsense; reading it ends."""
    known = {"a/msg/A": Definition("B b\n"), "a/msg/B": Definition("A a\nB[] more\n")}
    text = schema("a/msg/A", known)
    assert text is not None
    assert text.count("MSG: ") == 1


def test_a_schema_can_be_taken_apart() -> None:
    """What a recording has is enough for the definitions of all that is in it."""
    text = schema("geometry_msgs/msg/PoseStamped", KNOWN)
    assert text is not None
    found = definitions_in("geometry_msgs/msg/PoseStamped", text)
    assert {name: each.text for name, each in found.items()} == {
        name: each.text for name, each in KNOWN.items() if name.split("/")[0] != "a_msgs"
    }


def test_full_names() -> None:
    """Short names are messages unless one says otherwise."""
    assert full_type("a/B") == "a/msg/B"
    assert full_type("a/B", "srv") == "a/srv/B"
    assert full_type("a/msg/B", "srv") == "a/msg/B"


def test_names_that_are_none_have_no_schema() -> None:
    """A robot may say that a type needs one whose name has four parts, and tell that as well."""
    for name in ("a/b/c/d", "a/srv/B", "a/b/", "a"):
        known = {"a/msg/A": Definition(f"{name} x\n"), full_type(name): Definition("bool y\n"), name: Definition("")}
        assert schema("a/msg/A", known) is None, name


def test_a_schema_has_a_size() -> None:
    """Each of a thousand types that need all others is looked at once, and no more is put together than may be."""
    names = [f"a/msg/T{number}" for number in range(1000)]
    text = "".join(f"T{number} f\n" for number in range(1000))
    assert schema(names[0], dict.fromkeys(names, Definition(text))) is None
    some = dict.fromkeys(names[:100], Definition(text[: text.index("T100")]))
    whole = schema(names[0], some)
    assert whole is not None
    assert whole.count("MSG: ") == 99
    assert schema("a/msg/A", {"a/msg/A": Definition("#" * (SCHEMA_BYTES + 1))}) is None


async def test_of_a_robot_that_never_ends_it_is_told_that_there_is_more() -> None:
    """So much is asked of it and no more, and what was left is named."""
    asked: list[list[str]] = []

    async def ask(verb: str, data: bytes) -> bytes:
        asked.append(decode_data(DefinitionsRequest, data).types)
        number = 4 * len(asked)
        names = [*asked[-1], *(f"a_msgs/msg/T{number + each}" for each in range(3))]
        told = {name: Definition("x" * TEXT_BYTES) for name in names}
        return encode_data(DefinitionsReply(told, {}, [f"a_msgs/msg/T{number + 3}"]))

    told = await robot_types.definitions(ask)
    assert sum(len(each.text) for each in told.definitions.values()) < robot_types.MOST_BYTES + 4 * TEXT_BYTES + 1
    assert len(asked) < robot_types.ROUNDS
    assert told.left == [f"a_msgs/msg/T{4 * len(asked) + 3}"]
