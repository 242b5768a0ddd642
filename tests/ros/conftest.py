"""Real rclpy: a domain of its own for every test, kept on this machine; peers are nodes in contexts of their own."""

from __future__ import annotations

import itertools
import os
from collections.abc import AsyncIterator, Iterator

import pytest

# before rclpy starts: nothing of a test leaves this machine, and nothing else comes in
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.pop("ROS_STATIC_PEERS", None)

from ros_peer import Peer

from bridge.ros.session import RosSession

_domains = itertools.cycle(range(1, 101))
for _ in range(os.getpid() % 100):  # test runs at the same time begin at different domains
    next(_domains)


@pytest.fixture
def domain() -> int:
    """A ROS domain id for one test."""
    return next(_domains)


@pytest.fixture
def session(domain: int) -> Iterator[RosSession]:
    """The robot's ROS session."""
    with RosSession("rosagent", domain_id=domain) as session:
        yield session


@pytest.fixture
async def peer(domain: int) -> AsyncIterator[Peer]:
    """Another ROS node on the robot."""
    peer = Peer(domain)
    try:
        yield peer
    finally:
        peer.session.close()
