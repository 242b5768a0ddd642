"""How many of what another puts have come: a robot's topic data to a gateway, and an agent's commands to a robot."""

from __future__ import annotations

import pytest

from macs_zenoh.errors import WireError
from macs_zenoh.protocol.came import CommandsCame
from macs_zenoh.protocol.guard import BEFORE_ROBOT, Guard, Limits
from macs_zenoh.protocol.keyexpr import UNICAST
from macs_zenoh.protocol.messages import ROS, UNITY, Metadata, NodeType, encode_data
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import CommandCount
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message

KEY = UNICAST.of(type=ROS, id=7, from_type=UNITY, from_id=300)
OTHER = UNICAST.of(type=ROS, id=7, from_type=UNITY, from_id=301)


def count(put: int, since: int = 1) -> bytes:
    """What a gateway says."""
    return encode_data(CommandCount(since, put))


def frame(metadata: Metadata, data: bytes = b"\0\1\0\0\1") -> bytes:
    """A message to the robot."""
    return encode_frame(ROS, (7,), message=encode_message(metadata.encode(), data))


COMMAND = frame(Metadata(node_type=NodeType.PUBLISHER, node_name="nd__cmd_vel", data_exchange_type="x"))


def told(put: int, since: int = 1) -> bytes:
    """The same as a message."""
    return frame(Metadata(message_manager=CommandCount.manager), count(put, since))


def test_each_sender_is_counted_by_itself() -> None:
    """What is told of one, behind its commands, says nothing of another's; a count is no command."""
    came = CommandsCame()
    for key in (KEY, OTHER, KEY, KEY):  # the last one tells
        came.has_come(key)
    assert came.told(KEY, count(2)) == 0
    for _ in range(2):
        came.has_come(KEY)
    assert came.told(KEY, count(6)) == 3
    came.has_come(OTHER)
    assert came.told(OTHER, count(5)) == 0  # it begins there
    with pytest.raises(WireError):
        came.told(KEY, b"{}")


def test_names_that_somebody_makes_up_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """So many senders are remembered: those that sent last."""
    monkeypatch.setattr(CommandsCame, "SENDERS", 3)
    came = CommandsCame()
    for number in (1, 2, 1, 3, 4):
        came.has_come(str(number))
    assert list(came._of) == ["1", "3", "4"]


def test_a_robot_counts_what_does_not_come() -> None:
    """Commands that it drops itself, since they come too fast or have waited, have come, and have another name."""
    guard, lost, missing, taken = Guard(Limits(1, 100, 0.5), MACS), [], [], list[Message]()
    guard.me, guard.on_command = (ROS, 7), taken.append
    guard.on_dropped = lambda name, sender, why, count=1: lost.append((name, sender, count))
    guard.on_missing = lambda name, sender, why, count=1: missing.append((name, sender, count))

    def comes(payload: bytes, at: float, age_s: float = 0.0) -> None:
        if guard.admits(KEY, len(payload), True, at):
            assert guard.first(KEY, payload, age_s, at)

    comes(COMMAND, 0.0)
    comes(told(1), 10.0)
    for _ in range(5):
        comes(COMMAND, 20.0)
    comes(COMMAND, 30.0, age_s=1.0)
    comes(told(7), 40.0)
    assert {name for name, _, _ in lost} == {"flooded", "too_old"}
    assert (missing, len(taken)) == ([], 2)
    comes(COMMAND, 50.0)
    comes(told(11), 60.0)
    assert missing == [(BEFORE_ROBOT, "unity/300", 3)]
    comes(frame(Metadata(message_manager=CommandCount.manager), b"?"), 70.0)
    assert lost[-1][0] == "bad_request"


def test_a_count_is_no_message_to_a_robot() -> None:
    """Also where it comes behind what the loop has yet to handle."""
    guard = Guard(Limits(), MACS)
    metadata = Metadata(message_manager=CommandCount.manager)
    message = Message("unity", 300, metadata, count(3))
    assert guard.admits(KEY, 10, True, 0.0)
    assert guard.covered(KEY, 10, [message], 0.0) == []
    other = message._replace(metadata=Metadata(message_manager="x"))
    assert guard.covered(KEY, 10, [other], 0.0) == [other]


def test_counts_that_a_headset_makes_up_are_no_losses() -> None:
    """They come as its other messages do, with the largest and the least number, and change nothing of what a gateway
    tells behind its commands."""
    guard, missing = Guard(Limits(1000, 1000, 0.5), MACS), []
    guard.me, guard.on_command = (ROS, 7), lambda message: None
    guard.on_missing = lambda name, sender, why, count=1: missing.append((name, sender, count))

    def commands(put: int, at: float) -> None:
        for payload in (COMMAND, told(put)):
            assert guard.admits(KEY, len(payload), True, at)
            assert guard.first(KEY, payload, 0.0, at)

    commands(1, 0.0)
    metadata = Metadata(message_manager=CommandCount.manager)
    for number, put in enumerate((2**63 - 1, 0) * 50):
        assert guard.admits(KEY, 10, False, 1.0 + number)
        assert guard.covered(KEY, 10, [Message("unity", 300, metadata, count(put))], 1.0 + number) == []
    commands(2, 200.0)
    assert missing == []
