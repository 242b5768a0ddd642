"""Frames of topic data, and what can be said of CDR without decoding it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message

from bridge.ros.stream import StreamFraming, cdr_problem
from macs_zenoh.protocol.messages import Metadata, StreamData, decode_management
from macs_zenoh.protocol.wire import Layout, parse_frame

VECTORS = Path(__file__).parents[1] / "vectors" / "router"
METADATA = Metadata(1, 7, 0, StreamData.manager, 1, "nd__chatter", "std_msgs/String")


@pytest.mark.parametrize("layout", [Layout(), Layout(3, 2)], ids=str)
@pytest.mark.parametrize("registrants", [[], [(2, 5)], [(2, 9), (2, 5), (1, 3)], [(2, i) for i in range(1, 60)]])
def test_a_frame_is_whole_for_every_size(layout: Layout, registrants: list[tuple[int, int]]) -> None:
    """Whatever came before, each frame parses, names its receivers and carries its own bytes."""
    framing = StreamFraming(METADATA, registrants, layout)
    receivers: dict[str, list[int]] = {}
    for agent_type, agent_id in sorted(registrants):
        receivers.setdefault(str(agent_type), []).append(agent_id)
    for cdr in (b"\0\1\0\0", b"\0\1\0\0abcd", b"\0\1\0\0efgh", b"\0\1\0\0" + bytes(1 << 20), b"\0\1\0\0"):
        frame = parse_frame(framing(cdr), layout)
        assert frame.header[:3] == (1, (), ())
        assert decode_management(frame.management) == StreamData(receivers)
        assert Metadata.decode(frame.metadata) == METADATA
        assert frame.body == cdr


def test_a_frame_says_what_the_existing_robot_says() -> None:
    """The recorded frame of the existing robot and ours for the same message mean the same."""
    recorded = [
        parse_frame(bytes.fromhex(line["hex"]))
        for line in _lines("type1_subscriber_register_and_data.json")
        if line["dir"] == "agent->router" and '"RosAgentSubscriberDataForwarder"' in line["note"]
    ]
    assert recorded
    for frame in recorded:
        metadata = Metadata.decode(frame.metadata)
        management = decode_management(frame.management)
        assert isinstance(management, StreamData)
        registrants = [(int(kind), i) for kind, ids in management.dest_agents.items() for i in ids]
        ours = parse_frame(StreamFraming(metadata, registrants)(bytes(frame.body)))
        assert ours.destination == frame.destination
        assert decode_management(ours.management) == management
        assert Metadata.decode(ours.metadata) == metadata
        assert ours.body == frame.body


def _lines(name: str) -> list[dict[str, Any]]:
    lines: list[dict[str, Any]] = json.loads((VECTORS / name).read_text())
    return lines


TWIST = bytes(serialize_message(Twist()))


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "empty"),
        (b"\x00", "CDR header"),
        (b"\x00\x01\x00", "CDR header"),
        (b"\x06\x00\x00\x00hello\x00", "CDR header"),
        (b"\x00\x02\x00\x00" + bytes(48), "CDR header"),
        (TWIST[4:], "cut off"),  # zeros: without its header only the size tells
        (TWIST[:-1], "cut off"),
        (TWIST, None),
        (b"\x00\x00" + TWIST[2:], None),
        (TWIST + bytes(3), None),
    ],
)
def test_bytes_that_cannot_be_a_message_are_told(data: bytes, problem: str | None) -> None:
    """Empty, without encapsulation header or cut off is refused; padding at the end is not."""
    found = cdr_problem(data, len(TWIST))
    assert (found is None) if problem is None else (found is not None and problem in found)
