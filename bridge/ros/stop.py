"""The emergency stop as an interface node: a publisher (type 2) of std_msgs/Bool that is always there.

True stops, false releases. So any existing headset program can stop the robot: it publishes to a topic, which crosses
the mesh at the highest priority and needs no registration. The state is on the same topic for ROS nodes and for
subscribed headsets, latched.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile

from bridge.ros.interface import InterfaceNode, Registrant, Robot, ros_errors
from bridge.ros.rules import names_agent
from bridge.ros.stream import cdr_problem
from bridge.ros.topics import check_topic_type
from bridge.ros.types import resolve
from macs_zenoh.errors import Refused
from macs_zenoh.keyexpr import type_name
from macs_zenoh.messages import ROS, AddNode, NodeType, node_name
from macs_zenoh.reading import Message

log = logging.getLogger("macs.ros")

STATES = {True: b"\x00\x01\x00\x00\x01", False: b"\x00\x01\x00\x00\x00"}
"""std_msgs/Bool in CDR."""


class StopNode(InterfaceNode):
    """Stops and releases. ``on_stop`` is called with who did it, once per stop."""

    NODE_TYPE = NodeType.PUBLISHER
    ROLE = "emergency stop"

    def __init__(self, robot: Robot, topic: str, on_stop: Callable[[str], None]) -> None:
        super().__init__(
            robot, AddNode(ROS, robot.agent_id, NodeType.PUBLISHER, node_name(topic), topic, "std_msgs/Bool")
        )
        self._on_stop = on_stop
        self._publisher: Any = None

    @property
    def in_use(self) -> bool:
        return True

    def open(self) -> None:
        node, topic = self.robot.session.node, self.request.tos_name
        check_topic_type(node, topic, self.interface)
        with ros_errors(topic):
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._publisher = node.create_publisher(resolve(str(self.interface)), topic, latched)
        self._publisher.publish(STATES[self.robot.stop.stopped])

    def close(self) -> None:
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            self.robot.session.node.destroy_publisher(publisher)

    def receive(self, message: Message) -> None:
        sender = Registrant.of(message)
        problem = cdr_problem(message.data, 5)
        if problem is not None:
            self.robot.drops.note("bad_cdr", f"{self.topic} from {sender}", problem)
            self.robot.tell_refused(message, self.topic, "bad_cdr", problem)
            return
        try:
            self.set(sender, message.data[4] != 0)
        except Refused as refusal:
            self.robot.drops.note("not_allowed", f"{self.topic} from {sender}", refusal.reason)
            self.robot.tell_refused(message, self.topic, "not_allowed", refusal.reason)

    def set(self, sender: Registrant, stop: bool) -> None:
        """Stop or release. Raises Refused when the settings do not allow it to this agent."""
        settings = self.robot.rules.settings
        allowed = settings.stop_allow if stop else settings.release_allow
        if not names_agent(allowed, type_name(sender.agent_type), sender.agent_id, self.robot.group_of(sender)):
            raise Refused(f"{sender} may not {'stop' if stop else 'release'} this robot")
        if stop:
            self.press(str(sender))
        else:
            self.release(str(sender))

    def press(self, by: str) -> None:
        """Stop, latched. Again changes nothing."""
        if self.robot.stop.press(by, time.time()):
            self._on_stop(by)
            self._publish()
            log.warning("emergency stop by %s; commands are refused until it is released", by)

    def release(self, by: str) -> None:
        """Let commands pass again; the robot does nothing until one comes."""
        if self.robot.stop.release(by, time.time()):
            self._publish()
            log.warning("emergency stop released by %s", by)

    def _publish(self) -> None:
        if self._publisher is not None:
            self._publisher.publish(STATES[self.robot.stop.stopped])
