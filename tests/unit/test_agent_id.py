"""What identifies an agent, and its text."""

from __future__ import annotations

import pytest

from macs_zenoh import AgentInfo, UsageError
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.keyexpr import type_number


@pytest.mark.parametrize("text", ["ros/7", "unity/65535", "operator/0", "9/12"])
def test_its_text_is_read_back(text: str) -> None:
    """What is written is read as the same agent."""
    assert str(AgentId.parse(text)) == text


@pytest.mark.parametrize(
    "text", ["", "ros", "ros/", "ros/x", "ros/-1", "ros/٣", "ros/65536", "car/7", "/7", "ros/7/8"]
)
def test_other_text_is_nobody(text: str) -> None:
    """What is no agent is refused, by who wrote it."""
    with pytest.raises(UsageError):
        AgentId.parse(text)


def test_it_is_found_where_a_pair_is() -> None:
    """It is equal to its type and id, as the directory and others keep them."""
    agent = AgentInfo(1, 7, 0, "zid")
    assert agent.key == AgentId.parse("ros/7") == (1, 7)
    assert {(1, 7): "there"}[agent.key] == "there"
    assert str(agent.key) == "ros/7"


@pytest.mark.parametrize(("written", "number"), [("ros", 1), ("1", 1), (1, 1), (2, 2), ("unity", 2), (255, 255)])
def test_a_type_is_a_name_or_a_number(written: str | int, number: int) -> None:
    """Who is told a type's number, or its name, can send there."""
    assert type_number(written) == number


@pytest.mark.parametrize("written", [0, 256, -1, "0", "car", "", True])
def test_other_types_are_refused(written: str | int) -> None:
    """What is no type is said to be none."""
    with pytest.raises(UsageError, match="unknown agent type"):
        type_number(written)
