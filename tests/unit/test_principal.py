"""Whose rights somebody uses, as ``--as`` and settings say it."""

from __future__ import annotations

import pytest

from bridge.principal import Principal
from bridge.settings import GatewaySettings, OperatorSettings, RobotSettings, Settings
from macs_zenoh.errors import UsageError


def test_whose_rights_are_tried() -> None:
    """The settings say who somebody is, or --as does; what is nobody is refused."""
    assert str(Principal.of(Settings())) == ""
    assert str(Principal.of(Settings(robot=RobotSettings(id=7)))) == "ros/7"
    assert str(Principal.of(Settings(gateway=GatewaySettings(block=3)))) == "gateway/3"
    assert str(Principal.of(Settings(gateway=GatewaySettings(blocks=[4, 5])))) == "gateway/4"
    assert str(Principal.of(Settings(operator=OperatorSettings(id=5)))) == "operator/5"
    assert Principal.parse("gateway/1").agent == (2, 511)
    assert Principal.parse("ros/7").agent == (1, 7)
    assert not Principal.parse("observer").joins
    assert Principal.parse("operator/5").calls
    for text in ("robot", "ros/", "gateway/256", "ros/65536", "1/x", "drone/1"):
        with pytest.raises(UsageError):
            Principal.parse(text)
