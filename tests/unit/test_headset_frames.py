"""What the Python headset writes is what the C# headset was recorded to write, byte for byte."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from bridge.headset import frames
from bridge.headset.frames import NodeSpec
from macs_zenoh.errors import OutOfRange, TooManyDestinations
from macs_zenoh.protocol.messages import NodeType
from macs_zenoh.protocol.wire import parse_frame
from tests.unit.scripted_router import VECTORS, rows

SENT = [
    pytest.param(bytes.fromhex(row["hex"]), id=f"{path.stem}-{number}")
    for path in sorted(VECTORS.glob("*.json"))
    for number, row in enumerate(rows(path.stem))
    if row["dir"] == "agent->router" and row["hex"]
]


def again(data: bytes) -> bytes:
    """Build a recorded frame again from nothing but its values."""
    frame = parse_frame(data)
    metadata = json.loads(frame.metadata) if frame.metadata else {}
    if not frame.has_management:
        return _data_again(frame.header.agent_type, frame.header.ids, frame.header.groups, metadata, frame.body)
    management = json.loads(frame.management)
    match management["messageManager"]:
        case "AgentclientConfigurer":
            return frames.configuration(management["agentId"], management["groupId"], management["requestId"])
        case "HeartbeatHandler":
            return frames.heartbeat()
        case "UnityAgentclientRemover":
            return frames.go_offline(management["agentId"])
        case "OnlineAgentsGetter":
            return frames.online_request(management["agentId"], metadata["requestId"])
    body = json.loads(bytes(frame.body))
    node = NodeSpec(
        NodeType(management["nodeType"]),
        management["tosName"],
        management["dataExchangeType"],
        body.get("bufferSize", 10),
        body.get("dropNew", False),
        body.get("isLatched", False),
    )
    build = frames.registration if metadata["messageManager"] == "InterfaceNodeAdder" else frames.deregistration
    where = management["registrarAgentIds"], management["registrarGroupIds"]
    return build(management["registrantAgentId"], node, *where)


def _data_again(
    to_type: int, ids: tuple[int, ...], groups: tuple[int, ...], metadata: dict[str, object], body: memoryview
) -> bytes:
    sender, request_id = metadata["senderAgentId"], metadata["requestId"]
    if not metadata["nodeType"]:
        manager = metadata["messageManager"]
        return frames.plain_data(
            sender, body, to_type=to_type, ids=ids, groups=groups, manager=manager, request_id=request_id
        )
    topic = re.sub(r"^nd_", "", metadata["nodeName"]).replace("_", "/")
    node = NodeSpec(NodeType(metadata["nodeType"]), topic, metadata["dataExchangeType"])
    return frames.node_data(sender, node, body, ids, groups, request_id=request_id)


def test_there_are_recordings() -> None:
    """The table below covers the recordings of both builds of the C# program."""
    assert len(SENT) > 60
    assert any("noros2" in row.id for row in SENT)


@pytest.mark.parametrize("data", SENT)
def test_recorded_frames_are_written_the_same(data: bytes) -> None:
    """Every frame of the C# program comes out of the same values byte for byte."""
    assert again(data) == data


def test_the_node_name_follows_the_topic() -> None:
    """A node is named after its topic with slashes and tildes replaced."""
    assert NodeSpec(NodeType.PUBLISHER, "~/pose", "geometry_msgs/Pose").name == "nd___pose"


def test_a_registration_names_any_number_of_robots() -> None:
    """Registrations list robots in JSON, so ten slots do not limit them."""
    node = NodeSpec(NodeType.SUBSCRIBER, "/a", "std_msgs/String")
    frame = parse_frame(frames.registration(7, node, range(1, 60), (4,)))
    assert json.loads(frame.management)["registrarAgentIds"] == list(range(1, 60))


def test_data_goes_to_ten_at_most() -> None:
    """More than ten destinations of either kind, or a number too large, are refused before anything is sent."""
    node = NodeSpec(NodeType.PUBLISHER, "/a", "std_msgs/String")
    with pytest.raises(TooManyDestinations, match="11 destination ids"):
        frames.node_data(7, node, b"", range(1, 12))
    with pytest.raises(TooManyDestinations, match="11 destination groups"):
        frames.plain_data(7, b"", groups=range(1, 12))
    with pytest.raises(OutOfRange):
        frames.plain_data(7, b"", ids=(1 << 16,))


def test_the_recordings_are_whole() -> None:
    """Every recording of the C# program is in the table, so none is forgotten."""
    covered = {row.id.rpartition("-")[0] for row in SENT}
    only_received = {"subscribe_data"}
    assert {Path(path).stem for path in VECTORS.glob("*.json")} - only_received == covered
