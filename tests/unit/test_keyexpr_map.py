"""keyexpr_map.md says what macs_zenoh/protocol/keyexpr.py does, table by table."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import zenoh

from macs_zenoh.protocol import keyexpr
from macs_zenoh.protocol.keyexpr import KEYS

ROOT = Path(__file__).parents[2]


def tables() -> dict[str, list[dict[str, str]]]:
    """The tables of the page by the heading above them, each row by its column."""
    found: dict[str, list[dict[str, str]]] = {}
    heading = ""
    columns: list[str] = []
    for line in (ROOT / "keyexpr_map.md").read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            heading, columns = line[3:], []
        elif line.startswith("|---"):
            found[heading] = []
        elif line.startswith("|"):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if columns:
                found[heading].append(dict(zip(columns, cells, strict=True)))
            else:
                columns = cells
    return found


TABLES = tables()
EXAMPLES = TABLES["Examples of keys"]
SUBSCRIPTIONS = TABLES["What to subscribe to"]


def code(cell: str) -> str:
    """What stands between the backticks of a cell."""
    return cell.strip("`")


def test_the_key_spaces_are_those_of_the_code() -> None:
    """Every key space is in the table, with the code's key, publisher, subscriber and payload, and no other."""
    assert TABLES["Key spaces"] == [
        {
            "key space": name,
            "key": f"`{key.template}`",
            "published by": key.publisher,
            "subscribed by": key.subscriber,
            "payload": key.payload,
        }
        for name, key in KEYS.items()
    ]


def test_every_field_is_explained() -> None:
    """The fields explained are the fields that keys have."""
    explained = [name for row in TABLES["Fields"] for name in re.findall(r"`(\w+)`", row["field"])]
    assert sorted(explained) == sorted({name for key in KEYS.values() for name in key.fields})


def test_every_key_space_has_an_example() -> None:
    """No key space goes without an example of a key."""
    assert {row["key space"] for row in EXAMPLES} == set(KEYS)


@pytest.mark.parametrize("row", EXAMPLES, ids=lambda row: code(row["key"]))
def test_an_example_is_a_key_of_its_space(row: dict[str, str]) -> None:
    """Each example parses as a key of the space it stands for, and is built from its fields again."""
    parsed = keyexpr.parse(code(row["key"]))
    assert parsed is not None
    space, fields = parsed
    assert space == row["key space"]
    assert KEYS[space].of(**fields._asdict()) == code(row["key"])


@pytest.mark.parametrize("row", SUBSCRIPTIONS, ids=lambda row: code(row["key expression"]))
def test_a_subscription_is_what_its_code_makes(row: dict[str, str]) -> None:
    """The Python of each row makes its key expression, which touches the keys of one space only."""
    assert eval(code(row["in Python"]), vars(keyexpr)) == code(row["key expression"])  # our own page
    expression = zenoh.KeyExpr(code(row["key expression"]))
    assert len([name for name, key in KEYS.items() if expression.intersects(zenoh.KeyExpr(key.every()))]) == 1


def test_the_access_table_is_the_access_file() -> None:
    """What the table of access rules allows is what config/router-access.json5 allows."""
    access = json.loads(
        zenoh.Config.from_file(str(ROOT / "config" / "router-access.json5")).get_json("access_control")
    )
    rules = {rule["id"]: rule for rule in access["rules"]}
    subjects = {"robot 7": "robot 7", "a gateway": "gateways", "an observer": "observers"}
    for row in TABLES["Access rules"]:
        who, sends, receives, is_there = row.values()
        policies = [policy for policy in access["policies"] if subjects[who] in policy["subjects"]]
        granted = [rules[name] for policy in policies for name in policy["rules"]]
        assert allowed(granted, "put", "ingress") == set(re.findall(r"`([^`]+)`", sends))
        assert allowed(granted, "put", "egress") == set(re.findall(r"`([^`]+)`", receives))
        assert allowed(granted, "declare_subscriber", "ingress") == set(re.findall(r"`([^`]+)`", receives))
        assert allowed(granted, "liveliness_token", "ingress") == set(re.findall(r"`([^`]+)`", is_there))


def allowed(rules: list[dict[str, list[str]]], message: str, flow: str) -> set[str]:
    """The keys that some of the rules allow to a kind of message in one direction."""
    matching = [rule for rule in rules if message in rule["messages"] and flow in rule["flows"]]
    return {key for rule in matching for key in rule["key_exprs"]}
