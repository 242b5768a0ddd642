"""What docs/unity.md and docs/compatibility.md say of the gateway is what it has."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from bridge.settings import GatewaySettings, RobotSettings
from macs_zenoh.protocol.messages import (
    AddNode,
    CallFailure,
    Metadata,
    NodeRefused,
    NodeType,
    Registration,
    decode_data,
    decode_management,
    encode_data,
    node_name,
)
from macs_zenoh.protocol.tcp_agent import DEFAULT_LIMITS
from macs_zenoh.protocol.wire import encode_frame, encode_message
from tests.replay import RULES

DOCS = Path(__file__).parents[2] / "docs"
UNITY = (DOCS / "unity.md").read_text(encoding="utf-8")
COMPATIBILITY = (DOCS / "compatibility.md").read_text(encoding="utf-8")


def test_each_difference_is_told() -> None:
    """The table of accidents has exactly the differences that the replays allow."""
    table = COMPATIBILITY.partition("## Accidents")[2].partition("\n## ")[0]
    assert set(re.findall(r"^\| ([a-z ]+) \|", table, re.MULTILINE)) - {"difference"} == set(RULES)


def json_texts(section: str) -> list[str]:
    """The JSON blocks of a section of unity.md."""
    return re.findall(r"```json\n(.*?)\n```", UNITY.partition(section)[2].partition("\n## ")[0], re.DOTALL)


def test_the_registration_is_shown_as_it_is_sent() -> None:
    """The four JSON texts are a registration, its message's two parts, and the metadata of a request; the table of
    bytes is the frame of the first three."""
    management, adding, data, metadata = json_texts("## The four kinds of nodes")
    frame = encode_frame(management=management.encode(), message=encode_message(adding.encode(), data.encode()))
    rows = re.findall(
        r"^\| (\d+) \| (\d+)?[^|]*?(?:`([0-9a-f ]+)`)? \|", UNITY.partition("**one frame**")[2], re.MULTILINE
    )
    shown = {int(at): bytes.fromhex(text) * int(times or 1) for at, times, text in rows if text}
    assert len(shown) == 5
    for at, content in shown.items():
        assert frame[at : at + len(content)] == content
    assert f"to byte {len(frame)} |" in UNITY
    assert Metadata.decode(adding.encode()).message_manager == AddNode.manager
    registration = decode_management(management.encode())
    node = decode_data(AddNode, data.encode())
    assert isinstance(registration, Registration)
    assert registration.registrar_agent_ids == [1, 2]
    for name in ("registrant_agent_id", "node_type", "node_name", "tos_name", "data_exchange_type"):
        assert getattr(registration, name) == getattr(node, name)
    assert node.node_name == node_name(node.tos_name)
    request = Metadata.decode(metadata.encode())
    assert (request.node_type, request.request_id, request.node_name) == (NodeType.CLIENT, 12, node_name("/set"))
    for text, value in ((data, node), (metadata, request)):
        assert json.loads(text) == json.loads(encode_data(value))


def test_the_refusal_is_shown_as_it_is_sent() -> None:
    """The two JSON texts are what a refusal's metadata and data decode from and encode to."""
    metadata, data = json_texts("## Showing refusals")
    assert Metadata.decode(metadata.encode()) == Metadata(message_manager=NodeRefused.manager)
    assert json.loads(metadata) == json.loads(Metadata(message_manager=NodeRefused.manager).encode())
    refused = decode_data(NodeRefused, data.encode())
    assert set(json.loads(data)) == {"robotId", "nodeType", "nodeName", "tosName", "reason"}
    assert (refused.robot_id, refused.node_type, refused.tos_name) == (1, 1, "/chatter")


@pytest.mark.parametrize("name", ["handshake_timeout_s", "idle_timeout_s", "write_timeout_s"])
def test_times_are_the_defaults(name: str) -> None:
    """The gateway's times in the table are its defaults."""
    (seconds,) = re.findall(rf"^\| (\d+) s \| gateway \| `{name}`", UNITY, re.MULTILINE)
    assert float(seconds) == getattr(GatewaySettings(), name)


def test_limits_are_the_defaults() -> None:
    """Sizes in the text are the defaults."""
    settings = GatewaySettings()
    assert "more than 8 MiB" in COMPATIBILITY
    assert settings.outbox_bytes == 8 << 20
    assert "more than 32 MiB" in COMPATIBILITY
    assert settings.max_frame_bytes == 32 << 20
    assert "at most 256, and 1 MiB" in COMPATIBILITY
    assert (DEFAULT_LIMITS.held_frames, DEFAULT_LIMITS.held_bytes) == (256, 1 << 20)
    (seconds,) = re.findall(r"^\| (\d+) s \| robot \|", UNITY, re.MULTILINE)
    assert float(seconds) == getattr(RobotSettings(), "call_timeout_s", 5.0)


def test_the_four_kinds_are_there() -> None:
    """The table of node types has the four that existing programs know."""
    rows = re.findall(r"^\| (\d) \| (?:subscription|publisher|service client|service) \|", UNITY, re.MULTILINE)
    known = (NodeType.SUBSCRIBER, NodeType.PUBLISHER, NodeType.CLIENT, NodeType.SERVICE)
    assert [int(number) for number in rows] == [int(kind) for kind in known]


def test_the_failure_of_a_call_is_named() -> None:
    """The manager by which a program asks to be told is the robot's."""
    assert f"`{CallFailure.manager}`" in UNITY
