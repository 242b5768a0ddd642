"""What can be asked of a robot besides interface nodes: what it offers, its state, and control over a topic.

Over the wire these are plain messages to the robot whose manager is the name here; the answer has the same request id,
and empty manager and node name, as answers to plain requests have. On the mesh they are verbs. See docs/robot.md.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

import msgspec
from msgspec import UNSET

from bridge.audit import who
from bridge.ros.interface import Registrant, full_name
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.topics import PublisherNode
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.messages import NodeType
from macs_zenoh.protocol.robot_state import ControlReply, ControlRequest, RobotStatus, StopStatus, TripsStatus

FRESH_PER_S = 100.0
GOOD_S = 0.05
"""So often somebody is told the state as it is; who asks besides is told what it was, so long ago at most."""

_NOTES = {"take": "control_taken", "release": "control_released", "give": "control_given"}


def control(nodes: InterfaceNodes, sender: Registrant, request: ControlRequest, now: float) -> ControlReply:
    """Do what a request for control asks. Raises Refused when the topic has no such control, and when who asks, or who
    shall have it, may not command this robot."""
    nodes.rights.check(sender)
    if request.action == "give":
        nodes.rights.check(Registrant(request.to_type, request.to))
    node = nodes.on_topic(NodeType.PUBLISHER, full_name(nodes.robot, PublisherNode, request.topic))
    if not isinstance(node, PublisherNode):
        raise Refused(f"nobody registered a publisher of {request.topic[:80]}")
    if node.control is None:
        raise Refused(f"{node.topic} is not under exclusive control on this robot")
    with node.lock:
        if request.action == "take":
            done = node.control.take(sender, now)
        elif request.action == "release":
            done = node.control.release(sender)
        else:
            done = node.control.give(sender, Registrant(request.to_type, request.to), now)
        holder = node.control.holder(now)
    reason = "" if done else f"{holder or 'nobody'} has control"
    if not done or request.action != "take":  # `Control` tells of what is taken
        what = f"{node.topic} to {Registrant(request.to_type, request.to)}" if request.action == "give" else node.topic
        nodes.robot.audit.record(_NOTES[request.action], who(str(sender)), what, reason or "done")
    return ControlReply(done, str(holder) if holder else "", reason)


def status(nodes: InterfaceNodes, ros_name: str, lost_before: Mapping[str, int], *, counts: bool = False) -> bytes:
    """The robot's state as JSON: interface nodes with who registered, control and dead-man, the stop, drops.

    ``lost_before`` counts what was lost between the mesh and the nodes; ``counts``: it counts which commands come.
    """
    stop = nodes.robot.stop
    state = RobotStatus(
        ros_node=ros_name,
        ros_domain=nodes.robot.session.domain,
        beside=nodes.robot.session.beside or UNSET,
        stopped=stop.stopped,
        stop=StopStatus(
            by=stop.by,
            pressed=list(stop.pressed),
            seconds=round(time.time() - stop.since, 1) if stop.stopped else 0,
            times=stop.times,
            history=stop.history,
            presses=stop.presses,
        ),
        nodes=[node.status() for node in nodes],
        trips={topic: TripsStatus(*told) for topic, told in nodes.robot.trips.all().items()},
        drops={**lost_before, **nodes.drops},
        max_timed_command_age_s=nodes.robot.rules.settings.max_timed_command_age_s,
        counts_commands=counts or UNSET,
    )
    return msgspec.json.encode(state)


class Told:
    """What is told to all who ask, and not put together anew for each of a flood of them."""

    def __init__(self, make: Callable[[], bytes]) -> None:
        self._make = make
        self._fresh = Credit(FRESH_PER_S, -math.inf)
        self._last = (-math.inf, b"")

    def now(self, now: float) -> bytes:
        """It, as it is or was a moment ago."""
        if self._fresh.take(1, now) or now - self._last[0] > GOOD_S:
            self._last = now, self._make()
        return self._last[1]
