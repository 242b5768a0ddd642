"""What settings say by name."""

from __future__ import annotations

from typing import Any

import pytest
from geometry_msgs.msg import Twist
from std_srvs.srv import SetBool

from bridge.ros import fields
from bridge.ros.rules import Rules, names_agent
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.errors import Refused


def test_the_first_rule_that_gives_a_setting_counts() -> None:
    """Rules for one topic add up, earlier ones before later ones."""
    rules = Rules(
        RobotSettings(
            rules=[
                TopicRule(match="/a/b", max_hz=5),
                TopicRule(match="/a/*", max_hz=10, depth=3),
                TopicRule(match="/c", call_timeout_s=1),
            ]
        )
    )
    assert (rules.of("/a/b").max_hz, rules.of("/a/b").depth) == (5, 3)
    assert (rules.of("/a/x").max_hz, rules.of("/a/x").depth) == (10, 3)
    assert rules.of("/d") == TopicRule(match="/**")
    assert (rules.call_timeout_s("/c"), rules.call_timeout_s("/a/b")) == (1, 5)


def test_parameters_of_nodes_are_hidden_unless_asked_for() -> None:
    """Without settings headsets reach every topic and service, but no node's parameters and nothing hidden."""
    names = ["/cmd_vel", "/a/set_parameters", "/set_parameters", "/rosout", "/a/_action/status"]
    assert [name for name in names if Rules().exposes(name)] == ["/cmd_vel"]
    assert Rules(RobotSettings(hide=[])).exposes("/a/set_parameters")
    only = Rules(RobotSettings(expose=["/camera/**"]))
    assert only.exposes("/camera/image")
    with pytest.raises(Refused, match="/cmd_vel is not open to headsets on this robot"):
        only.check_exposed("/cmd_vel")


@pytest.mark.parametrize(
    ("patterns", "named"),
    [
        (["*"], True),
        (["unity"], True),
        (["unity/5"], True),
        (["block/0"], True),
        (["block/1"], False),
        (["group/3"], True),
        (["ros"], False),
    ],
)
def test_agents_are_named_by_type_id_and_group(patterns: list[str], named: bool) -> None:
    """Each way to name headset 5 of group 3."""
    assert names_agent(patterns, "unity", 5, 3) is named


def test_a_message_is_filled_from_settings() -> None:
    """Nested fields are set, whole numbers count as floats where the field is one."""
    assert fields.filled(Twist, {"linear": {"x": 1}}, "deadman_message").linear.x == 1.0


@pytest.mark.parametrize("values", [{"linaer": {}}, {"linear": {"x": "fast"}}, {"linear": 3}])
def test_settings_that_do_not_fit_a_type_are_refused(values: dict[str, Any]) -> None:
    """The refusal names the setting."""
    with pytest.raises(Refused, match="deadman_message"):
        fields.filled(Twist, values, "deadman_message")


def test_a_failed_service_says_so() -> None:
    """Its response is false and carries the reason, or is what the settings say."""
    assert fields.failure(SetBool.Response, "no answer", None, "") == SetBool.Response(message="no answer")
    assert fields.failure(SetBool.Response, "no answer", {"message": "x"}, "") == SetBool.Response(message="x")
