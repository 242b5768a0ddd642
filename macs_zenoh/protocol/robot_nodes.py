"""The interface nodes of one existing robot program, as its gateway told it, and what it survives being told. Pure.

Such a program answers no registration and refuses none: a type that it does not have, an invalid name or a second node
under one name ends the thread that all messages to it go through. So its gateway knows the rules, and refuses with a
reason. Which types such a robot has is known from what it says it offers, and from its gateway's settings.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterable

from ..errors import HeldByAnother, Refused
from .agent_id import AgentId
from .budget import may_have_one_more
from .limits import NODES_EACH
from .messages import AddNode, Functionality, GoneAgent, NodeType, RemoveNode, node_name

MAX_BUFFER = 65535
"""Larger depths of a queue are no number that ROS takes, or all of a robot's memory."""

NODES = 4 * NODES_EACH
"""Such a program makes a ROS node of each without end. One agent has as many as its gateway lets it have."""

LONGEST_TOPIC = 247
"""As long as ROS 2 lets a topic's full name be."""

_TOPIC = re.compile(r"(~/|/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_TYPE = re.compile(r"([a-z][a-z0-9_]{0,99})/([A-Z][A-Za-z0-9]{0,99})")

_MESSAGES = {
    "std_msgs": """
        Bool Byte ByteMultiArray Char ColorRGBA Empty Float32 Float32MultiArray Float64 Float64MultiArray Header Int16
        Int16MultiArray Int32 Int32MultiArray Int64 Int64MultiArray Int8 Int8MultiArray MultiArrayDimension
        MultiArrayLayout String UInt16 UInt16MultiArray UInt32 UInt32MultiArray UInt64 UInt64MultiArray UInt8
        UInt8MultiArray""",
    "std_srvs": "",
    "geometry_msgs": """
        Accel AccelStamped AccelWithCovariance AccelWithCovarianceStamped Inertia InertiaStamped Point Point32
        PointStamped Polygon PolygonInstance PolygonInstanceStamped PolygonStamped Pose Pose2D PoseArray PoseStamped
        PoseWithCovariance PoseWithCovarianceStamped Quaternion QuaternionStamped Transform TransformStamped Twist
        TwistStamped TwistWithCovariance TwistWithCovarianceStamped Vector3 Vector3Stamped VelocityStamped Wrench
        WrenchStamped""",
    "sensor_msgs": """
        BatteryState CameraInfo ChannelFloat32 CompressedImage FluidPressure Illuminance Image Imu JointState Joy
        JoyFeedback JoyFeedbackArray LaserEcho LaserScan MagneticField MultiDOFJointState MultiEchoLaserScan NavSatFix
        NavSatStatus PointCloud PointCloud2 PointField Range RegionOfInterest RelativeHumidity Temperature
        TimeReference""",
}
_SERVICES = {"std_srvs": "Empty SetBool Trigger", "sensor_msgs": "SetCameraInfo"}

STANDARD = {
    package: (frozenset(messages.split()), frozenset(_SERVICES.get(package, "").split()))
    for package, messages in _MESSAGES.items()
}
"""Messages and services of the packages that everybody uses: there a mistake in a name can be seen."""

_COMMON = """
    action_msgs actionlib_msgs builtin_interfaces diagnostic_msgs geometry_msgs lifecycle_msgs nav_msgs rcl_interfaces
    rosgraph_msgs sensor_msgs shape_msgs std_msgs std_srvs stereo_msgs tf2_msgs trajectory_msgs unique_identifier_msgs
    visualization_msgs"""
COMMON = frozenset(_COMMON.split())
"""Packages that every installation of ROS 2 has."""

AgentKey = tuple[int, int]
NodeKey = tuple[int, str]


class RobotNodes:
    """What one existing robot program was told, until it was told otherwise. ``packages`` are those that it has
    besides the `COMMON` ones."""

    def __init__(self, packages: Collection[str] = ()) -> None:
        self._packages = COMMON.union(packages) if packages else COMMON
        self._nodes: dict[NodeKey, AddNode] = {}
        """As the first registrant asked for them."""
        self._registrants: dict[NodeKey, dict[AgentKey, None]] = {}

    def find(self, node_type: int, name: str) -> AddNode | None:
        """The node of this type and name; for a service its registrant is who answers."""
        return self._nodes.get((node_type, name))

    def add(self, node: AddNode, offered: Functionality | None = None, *, existing: bool = True) -> bool:
        """Whether the robot has to be told of a registration: not when it was, because it makes a second ROS node of
        one heard twice. ``offered`` is what the robot says it has; one that is not ``existing`` judges by itself.

        Raises Refused for what it would not survive, HeldByAnother where somebody else serves.
        """
        key, agent = (node.node_type, node.node_name), (node.registrant_agent_type, node.registrant_agent_id)
        there = self._nodes.get(key)
        if there is None:
            if existing:
                check(node, offered, self._packages)
            self._check_room(agent)
        else:
            self._check_same(node, there, agent)
            if agent in self._registrants[key]:
                return False
        self._nodes.setdefault(key, node)
        self._registrants.setdefault(key, {})[agent] = None
        return True

    def remove(self, node: RemoveNode) -> bool:
        """Whether the robot has to be told: only of a registration that it has."""
        return self._remove((node.node_type, node.node_name), (node.registrant_agent_type, node.registrant_agent_id))

    def gone(self, agents: Iterable[GoneAgent]) -> None:
        """A robot program that hears of these takes them off its nodes."""
        if self._nodes:
            left = {(agent.agent_type, agent.agent_id) for agent in agents}
            for key in list(self._nodes):
                for agent in left.intersection(self._registrants[key]):
                    self._remove(key, agent)

    def registrants(self) -> list[GoneAgent]:
        """Everybody who is registered."""
        every = (agent for registrants in self._registrants.values() for agent in registrants)
        return [GoneAgent(*agent) for agent in dict.fromkeys(every)]

    def _remove(self, key: NodeKey, agent: AgentKey) -> bool:
        registrants = self._registrants.get(key, {})
        if agent not in registrants:
            return False
        del registrants[agent]
        if not registrants:
            del self._nodes[key], self._registrants[key]
        return True

    def _check_room(self, agent: AgentKey) -> None:
        if len(self._nodes) >= NODES:
            raise Refused(f"this robot has {NODES} interface nodes, which is its limit")
        mine = sum(agent in registrants for registrants in self._registrants.values())
        if not may_have_one_more(len(self._nodes), mine, each=NODES_EACH, total=NODES):
            raise Refused(f"{AgentId(*agent)} has {mine} interface nodes on this robot; the rest is for others")

    def _check_same(self, node: AddNode, there: AddNode, agent: AgentKey) -> None:
        if node.tos_name != there.tos_name:
            names = f"{node.tos_name[:80]} and {there.tos_name} have the same node name {node.node_name}"
            raise Refused(f"{names}; use one of them")
        if node.data_exchange_type != there.data_exchange_type:
            other = node.data_exchange_type[:80]
            raise Refused(f"{node.tos_name} is registered with type {there.data_exchange_type}, not {other}")
        holder = (there.registrant_agent_type, there.registrant_agent_id)
        if node.node_type == NodeType.SERVICE and holder != agent:
            other = f"another agent, {AgentId(*holder)}"
            why = f"{node.tos_name} is already registered by {other}: a service of headsets has only one"
            raise HeldByAnother(why, holder)


def check(node: AddNode, offered: Functionality | None, packages: Collection[str] = COMMON) -> None:
    """Raise Refused for a new node that an existing robot program does not survive, as far as that can be known."""
    kind, topic = node.node_type, node.tos_name
    if kind not in (NodeType.SUBSCRIBER, NodeType.PUBLISHER, NodeType.CLIENT, NodeType.SERVICE):
        raise Refused(f"this robot's program is an existing one, which has no nodes of type {kind}")
    if len(topic) > LONGEST_TOPIC or not _TOPIC.fullmatch(topic):
        raise Refused(f"{topic[:80]!r} is no name that ROS takes")
    if node.node_name != node_name(topic):
        raise Refused(f"the node of {topic} is called {node_name(topic)}, not {node.node_name[:80]!r}")
    if node.buffer_size > MAX_BUFFER:
        raise Refused(f"{topic} with a buffer of more than {MAX_BUFFER} messages")
    service = kind in (NodeType.CLIENT, NodeType.SERVICE)
    _check_type(node.data_exchange_type, int(service), _types(offered), packages)


def _types(offered: Functionality | None) -> set[str]:
    if offered is None:
        return set()
    return {*offered.publishers.values(), *offered.subscribers.values(), *offered.services.values()}


def _check_type(name: str, kind: int, offered: set[str], packages: Collection[str]) -> None:
    """``kind`` is 0 for messages, 1 for services."""
    parsed = _TYPE.fullmatch(name)
    if parsed is None:
        raise Refused(f"{name[:80]!r} is not how a type is written, as in std_msgs/String")
    package, word = parsed.groups()
    if package in sys.stdlib_module_names:
        raise Refused(f"{package} is a module of Python and no package of ROS types")
    standard = STANDARD.get(package)
    if f"{package}/{'srv' if kind else 'msg'}/{word}" in offered:
        return
    if standard is not None and word not in standard[kind]:
        raise Refused(f"there is no {'service' if kind else 'message'} type {word} in {package}")
    if package not in packages and not any(known.startswith(f"{package}/") for known in offered):
        raise Refused(
            f"this robot's program is an existing one and names no type of {package}; if it has that package, its "
            "gateway's settings must say so (gateway.robot_packages)"
        )
