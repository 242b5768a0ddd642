"""Hashes of ROS types: by their definitions, and by what a ROS node says of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from macs_zenoh.type_hashes import Hashes, learn
from macs_zenoh.typed import Types, UnknownType
from tests.support.rmw_vectors import rows

FIBONACCI = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"
ADD_TWO_INTS = "int64 a\nint64 b\n---\nint64 sum\n"
FIBONACCI_PARTS = {
    "SendGoal": "d1a57fb2a4afe8c21e34fb10db206f16ce6729b28531141472df92277c55b557",
    "GetResult": "1b0de0d5d29dc955d92f546706568428632771db13ec84c15ec1c1a59f424a57",
    "FeedbackMessage": "c1de71afd52e49a89c53d8262366884185bc0a02f78ce051c4e46b0a7fe59bb2",
}
KNOWN = {
    **{f"example_interfaces/action/Fibonacci_{part}": known for part, known in FIBONACCI_PARTS.items()},
    "example_interfaces/srv/AddTwoInts": "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    "action_msgs/srv/CancelGoal": "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a",
    "type_description_interfaces/srv/GetTypeDescription": (
        "69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5"
    ),
}


@pytest.fixture
def types(tmp_path: Path) -> Types:
    for kind, name, text in (("action", "Fibonacci", FIBONACCI), ("srv", "AddTwoInts", ADD_TWO_INTS)):
        path = tmp_path / "example_interfaces" / kind / f"{name}.{kind}"
        path.parent.mkdir(parents=True)
        path.write_text(text, encoding="utf-8")
    return Types([tmp_path])


def test_hashes_of_types_are_those_of_ros(types: Types) -> None:
    """Of every type of ROS's common interfaces that has a definition here, messages and services."""
    hashes, compared = Hashes(types), 0
    for row in rows("type_hashes"):
        name = row["type"]
        if name.endswith(("_Event", "_Request", "_Response")):
            continue
        try:
            found = hashes.of(name)
        except UnknownType:
            assert "/msg/" not in name, name
            continue
        assert found == row["hash"], name
        compared += 1
    assert compared > 100


@pytest.mark.parametrize("name", KNOWN)
def test_hashes_of_services_and_parts_of_actions(types: Types, name: str) -> None:
    """As the real middleware has them in its keys."""
    assert Hashes(types).of(name) == f"RIHS01_{KNOWN[name]}"


def described(name: str, *fields: tuple[str, int, str]) -> dict[str, Any]:
    return {
        "type_name": name,
        "fields": [
            {
                "name": field,
                "type": {"type_id": number, "capacity": 0, "string_capacity": 0, "nested_type_name": nested},
                "default_value": "",
            }
            for field, number, nested in fields
        ],
    }


def test_types_are_learned_from_a_description() -> None:
    """What a node says of a service of its own is enough to write its messages and to know its hash."""
    types = Types()
    learn(
        types,
        {
            "type_description": described("shop_msgs/srv/Buy", ("request_message", 1, "shop_msgs/srv/Buy_Request")),
            "referenced_type_descriptions": [
                described("shop_msgs/srv/Buy_Request", ("what", 1 + 144, "shop_msgs/msg/Item"), ("many", 6, "")),
                described("shop_msgs/srv/Buy_Response", ("message", 17, "")),
                described("shop_msgs/msg/Item", ("name", 17, ""), ("weights", 11 + 144, "")),
                described("shop_msgs/srv/Buy_Event", ("request", 1 + 96, "shop_msgs/srv/Buy_Request")),
            ],
        },
    )
    value = {"what": [{"name": "nut", "weights": [1.5]}], "many": 3}
    cdr = types.serialize("shop_msgs/srv/Buy_Request", value)
    assert types.deserialize("shop_msgs/srv/Buy_Request", cdr) == value
    assert Hashes(types).of("shop_msgs/srv/Buy").startswith("RIHS01_")


@pytest.mark.parametrize(
    "bad",
    [
        [described("a_msgs/msg/A", ("b", 1, "a_msgs/msg/B")), described("a_msgs/msg/B", ("a", 1, "a_msgs/msg/A"))],
        [described("a_msgs/msg/A", ("b", 47, ""))],
        [described("a_msgs/msg/A", ("b", 255, ""))],
        [described("a_msgs/msg/A", ("b\nint8 c", 2, ""))],
        [described("../msg/A", ("b", 2, ""))],
        [described(f"a_msgs/msg/A{number}", ("b", 2, "")) for number in range(600)],
    ],
)
def test_descriptions_of_what_cannot_be(bad: list[dict[str, Any]]) -> None:
    """They are refused by name, whatever they describe."""
    with pytest.raises(UnknownType):
        learn(Types(), {"type_description": bad[0], "referenced_type_descriptions": bad[1:]})
