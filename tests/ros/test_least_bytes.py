"""What a gateway knows of the length of ROS data, against what ROS writes."""

from __future__ import annotations

from importlib import import_module

import pytest
from rclpy.serialization import serialize_message

from macs_zenoh.protocol.least_bytes import ANSWERS, LEAST


@pytest.mark.parametrize("name", LEAST)
def test_no_message_of_ros_is_shorter(name: str) -> None:
    """The shortest message of a type is as long as is known, or padded to 8 bytes by ROS."""
    package, word = name.split("/")
    size = len(serialize_message(getattr(import_module(f"{package}.msg"), word)()))
    assert size == max(8, LEAST[name])


@pytest.mark.parametrize("name", ANSWERS)
def test_no_answer_of_ros_is_shorter(name: str) -> None:
    """The same for the answers of services."""
    package, word = name.split("/")
    answer = getattr(import_module(f"{package}.srv"), word).Response()
    assert ANSWERS[name] <= len(serialize_message(answer)) < ANSWERS[name] + 4
