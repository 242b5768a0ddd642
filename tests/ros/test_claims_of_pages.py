"""What pages promise of a robot, tried: sentences that were once untrue, or would be noticed late."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import pytest
from std_msgs.msg import String

from bridge.ros.agent import RobotAgent
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Refused, Unreachable
from macs_zenoh.protocol.messages import encode_data as encode
from macs_zenoh.protocol.wire import parse_frame
from tests.support.ros_peer import ROBOT, Peer, Streams, adding

DOCS = Path(__file__).parents[2] / "docs"


async def test_a_robot_answers_the_verbs_of_the_page(robot: RobotAgent, headset: Agent) -> None:
    """docs/protocol.md: each verb of the table is served by a robot's agent, another one is not."""
    table = (DOCS / "protocol.md").read_text(encoding="utf-8").partition("| verb |")[2].partition("\n\n")[0]
    verbs = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    assert len(verbs) == 9
    for verb in verbs:
        with contextlib.suppress(Refused):  # what it says no to, it serves
            await headset.call("ros", ROBOT, verb, b"{}")
    with pytest.raises(Unreachable, match="nobody there answers this call"):
        await headset.call("ros", ROBOT, "add_nodes", timeout_s=1)


async def test_topic_data_is_not_decoded(robot: RobotAgent, headset: Agent, peer: Peer) -> None:
    """docs/design.md: bytes that are no message of the topic's type cross as they are."""
    streams = Streams(headset)
    await headset.call("ros", ROBOT, "add_node", encode(adding("/chatter")))
    publisher = await peer.publisher(String, "/chatter", matched=1)
    odd = b"\x00\x01\x00\x00\xff\xff\xff\x7fno string of that length"
    _, payload = await streams.after(lambda: publisher.publish(odd))
    assert bytes(parse_frame(payload).body).startswith(odd)
