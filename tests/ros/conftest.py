"""Real rclpy: a domain of its own for every test, kept on this machine; peers are nodes in contexts of their own."""

from __future__ import annotations

import importlib
import itertools
import os
import sys
import zipfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

# before rclpy starts: nothing of a test leaves this machine, and nothing else comes in
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.pop("ROS_STATIC_PEERS", None)

import macs_zenoh
from bridge import interfaces
from bridge.interfaces import build
from bridge.ros.agent import RobotAgent
from bridge.ros.program import open_robot
from bridge.ros.session import RosSession
from bridge.ros.topics import PublisherNode
from bridge.settings import RobotSettings, Settings
from macs_zenoh.agent import Agent
from tests.support.isolation import worker_number
from tests.support.local import patient
from tests.support.once import made_of
from tests.support.ros_peer import ROBOT, Peer
from tests.support.waiting import PATIENCE_S, until

DOMAINS = 100
_domains = itertools.cycle(range(1, 1 + DOMAINS))
# test runs at the same time begin at different domains, and so do the workers of one run that share a network
for _ in range((os.getpid() + worker_number() * DOMAINS // 8) % DOMAINS):
    next(_domains)


def _installed(package: str) -> Path:
    """An interface package, built from its definitions; the processes of a test find it as well. Its prefix."""

    def make(into: Path) -> None:
        with zipfile.ZipFile(build(source, into).wheel) as wheel:
            wheel.extractall(into)

    source = Path(__file__).parent / package
    into = made_of(package, [source, Path(interfaces.__file__).parent], make)
    prefix = next(into.glob("*.data")) / "data"
    sys.path.insert(0, str(into))
    for variable, value in (("AMENT_PREFIX_PATH", str(prefix)), ("PYTHONPATH", str(into))):
        os.environ[variable] = os.pathsep.join([value, *filter(None, [os.environ.get(variable)])])
    return prefix


@pytest.fixture(scope="session")
def count_action() -> Any:
    """An action. None comes from PyPI."""
    _installed("macs_test_msgs")
    return importlib.import_module("macs_test_msgs.action").Count


@pytest.fixture(scope="session")
def kinds() -> Any:
    """Messages with every kind of field: the module that has them."""
    _installed("macs_kinds_msgs")
    return importlib.import_module("macs_kinds_msgs.msg")


@pytest.fixture(autouse=True)
def _patient_publishers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot's new publisher has the time of a busy machine to find the subscriptions that are there: the first
    command would be lost otherwise, and no test sends it twice."""
    monkeypatch.setattr(PublisherNode, "MATCH_S", 10.0)


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


@pytest.fixture
async def robot(router: str, domain: int) -> AsyncIterator[RobotAgent]:
    """Robot 7 in group 3."""
    patience = RobotSettings(id=ROBOT, group=3, call_timeout_s=PATIENCE_S)
    settings = Settings(mesh=patient(router), robot=patience)
    async with open_robot(settings, domain_id=domain) as robot:
        yield robot


@pytest.fixture
async def headset(router: str, robot: RobotAgent) -> AsyncIterator[Agent]:
    """Headset 5, a Python agent, which knows of the robot."""
    async with macs_zenoh.join("unity", id=5, settings=patient(router)) as headset:
        await until(lambda: (1, ROBOT) in headset.directory)
        yield headset
