"""A node that fails where it should be stopped, left or removed keeps no other from that."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable

import pytest

from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.ros.topics import PublisherNode
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.protocol.messages import NodeType
from tests.ros.driven import STOPPED, hear
from tests.support.ros_peer import Peer, adding, drive
from tests.support.waiting import until

RULE = TopicRule(match="/**", deadman_s=60, deadman_message={"linear": {"z": -1}})
TOPICS = ("/base", "/arm")


@pytest.fixture
async def nodes(session: RosSession) -> AsyncIterator[InterfaceNodes]:
    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, rules=Rules(RobotSettings(rules=[RULE]))))
    yield nodes
    nodes.close()


@pytest.mark.parametrize(
    ("method", "ends"),
    [
        ("left", lambda nodes: nodes.forget(Registrant(2, 5))),
        ("deregister", lambda nodes: nodes.forget(Registrant(2, 5))),
        ("cut_off", InterfaceNodes.cut_off),
        ("retire", InterfaceNodes.last_words),
        ("retire", InterfaceNodes.forget_all),
        ("emergency_stop", lambda nodes: nodes._stopped("operator")),
    ],
)
async def test_the_next_one_is_stopped(
    nodes: InterfaceNodes,
    peer: Peer,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
    ends: Callable[[InterfaceNodes], None],
) -> None:
    """However it ends, the arm gets its stop message though the base, which comes before it, fails."""
    heard = {topic: await hear(peer, topic) for topic in TOPICS}
    for topic, said in heard.items():
        await nodes.add(adding(topic, "geometry_msgs/Twist", node_type=NodeType.PUBLISHER))
        await until(lambda topic=topic, said=said: (nodes.deliver(drive(0.5, topic=topic)), said.last == 0.5)[1])
    working = getattr(PublisherNode, method)

    def failing(node: PublisherNode, *args: object) -> None:
        if node.topic == "/base":
            raise RuntimeError("a fault of ours")
        working(node, *args)

    monkeypatch.setattr(PublisherNode, method, failing)
    ends(nodes)
    await until(lambda: heard["/arm"].last == STOPPED)
    monkeypatch.undo()
