"""A robot agent as a process, driven over a real router by an agent of the test; and what its ROS topics carry."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message

from macs_zenoh import join
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from macs_zenoh.protocol.messages import AddNode, Metadata, NodeType, encode_data, node_name
from tests.support.programs import Program
from tests.support.ros_peer import Peer, drive
from tests.support.routers import Router
from tests.support.waiting import until

STOPPED = -1.0
"""What `Heard.values` shows of a stop message."""

SETTINGS = """
[[robot.rules]]
match = "/cmd_vel"
deadman_s = {deadman_s}
deadman_message = {{ linear = {{ z = -1 }} }}
"""


@dataclass
class Heard:
    """What came on a topic of Twists: when, and linear x, or z where that is the stop message's."""

    values: list[tuple[float, float]] = field(default_factory=list)
    _from_ns: int = 0
    """What was published before is not taken any more: a busy machine hands it over late."""
    _taking: threading.Lock = field(default_factory=threading.Lock)

    def take(self, twist: Any, info: dict[str, Any]) -> None:
        with self._taking:
            if info["source_timestamp"] >= self._from_ns:
                self.values.append((time.monotonic(), twist.linear.x or twist.linear.z))

    def forget(self) -> None:
        """All that was published until now, also what has not come yet."""
        with self._taking:
            self._from_ns = time.time_ns()
            self.values.clear()

    def since(self, moment: float) -> list[float]:
        return [value for at, value in self.values if at > moment]

    @property
    def last(self) -> float | None:
        return self.values[-1][1] if self.values else None


async def hear(peer: Peer, topic: str = "/cmd_vel", depth: int = 1000) -> Heard:
    """Listen to a topic in the ROS thread, so that a busy test does not make a message late."""
    heard = Heard()
    await peer.session.run(lambda: peer.session.node.create_subscription(Twist, topic, heard.take, depth))
    return heard


async def may_command(driver: Agent, robot: int, topic: str = "/cmd_vel", kind: str = "geometry_msgs/Twist") -> None:
    """Register as a publisher of a topic, once the robot is there."""
    await until(lambda: (1, robot) in driver.directory)
    asked = AddNode(driver.type_number, driver.id, NodeType.PUBLISHER, node_name(topic), topic, kind)
    await driver.call("ros", robot, "add_node", encode_data(asked), timeout_s=20)


def send(driver: Agent, robot: int, x: float, topic: str = "/cmd_vel") -> None:
    """One command."""
    message = drive(x, topic=topic)
    driver.send(message.data, to="ros", ids=[robot], metadata=message.metadata)


def send_bool(driver: Agent, robot: int, value: bool, topic: str = "/emergency_stop") -> None:
    """A Bool on a topic, as existing headsets stop and release."""
    metadata = Metadata(node_type=NodeType.PUBLISHER, node_name=node_name(topic), data_exchange_type="std_msgs/Bool")
    driver.send(b"\x00\x01\x00\x00" + bytes([value]), to="ros", ids=[robot], metadata=metadata)


@asynccontextmanager
async def driving(driver: Agent, robot: int, x: float = 0.5, hz: float = 20) -> AsyncIterator[None]:
    """Command all the time."""

    async def drive_on() -> None:
        while True:
            send(driver, robot, x)
            await asyncio.sleep(1 / hz)

    task = asyncio.create_task(drive_on())
    try:
        yield
    finally:
        task.cancel()


@dataclass
class Site:
    """A router, and how to reach it."""

    router: Router
    mesh: MeshSettings
    settings: Path
    domain: int

    def robot(self, number: int = 1, *argv: str, router: str = "", env: Mapping[str, str] | None = None) -> Program:
        """A robot agent, not started yet."""
        common = ("-e", router or self.router.endpoint, "--settings", str(self.settings))
        return Program(
            "agent", "--id", str(number), *common, *argv, env={"ROS_DOMAIN_ID": str(self.domain), **(env or {})}
        )

    def headset(self, number: int = 300) -> Any:
        """An agent like a headset, to be entered."""
        return join("unity", id=number, settings=self.mesh)

    def operator(self, number: int) -> Any:
        """An operator, to be entered."""
        return join("operator", id=number, settings=self.mesh)


@asynccontextmanager
async def site(domain: int, tmp_path: Path, settings: str = SETTINGS.format(deadman_s=0.5)) -> AsyncIterator[Site]:
    """A router and settings for a robot."""
    path = tmp_path / "macs.toml"
    path.write_text(settings)
    async with Router() as router:
        yield Site(router, MeshSettings(connect=[router.endpoint]), path, domain)


def stop_cdr() -> bytes:
    """The stop message of `SETTINGS`."""
    twist = Twist()
    twist.linear.z = STOPPED
    return bytes(serialize_message(twist))


async def told(agent: Agent, robot: int) -> Any:
    """What a robot answers when it is asked for its state."""
    return json.loads(await agent.call("ros", robot, "status"))
