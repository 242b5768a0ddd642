"""What a robot says of itself, and what it is asked for besides: the same for the robot and for who asks. Pure.

As JSON: verbs on the mesh, and plain messages to the robot whose manager is the name here. See docs/robot.md.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from msgspec import UNSET, Struct, UnsetType, field, structs

from .messages import AgentId, AgentType, Count, Functionality

STATUS = "RobotStatus"
"""Manager of a request for a robot's state; its data is ignored."""


class ControlStatus(Struct, frozen=True):
    """Who commands a topic."""

    holder: str | None = None
    seconds_held: float = 0
    seconds_left: float = 0


class DeadManStatus(Struct, frozen=True):
    """What happens when commands stop, and how often it has."""

    silence_s: float | None = None
    commander: str | None = None
    trips: Count = 0
    last: str = ""


class TripsStatus(Struct, frozen=True):
    """How often the dead-man of a topic has acted, and why the last time."""

    times: Count = 0
    why: str = ""


class GoalStatus(Struct, frozen=True):
    """A goal that an action works on, or whose result waits; ``status`` as ROS numbers it."""

    goal: str = ""
    status: int = 0
    owner: str = ""
    finished: bool = False


class CarriedStatus(Struct, frozen=True):
    """Messages of a topic since somebody registered it, their bytes of CDR, and how long ago the last one was."""

    messages: Count = 0
    bytes: Count = 0
    age_s: float | None = None


class NodeStatus(Struct, frozen=True):
    """An interface node and what is going on there: what it has none of is left out."""

    role: str
    name: str
    type: str
    registrants: list[str] = []
    control: ControlStatus | UnsetType = UNSET
    deadman: DeadManStatus | UnsetType = UNSET
    open_calls: int | UnsetType = UNSET
    goals: list[GoalStatus] | UnsetType = UNSET
    carried: CarriedStatus | UnsetType = UNSET
    shared_with: list[int] | UnsetType = UNSET
    """Ids of other robots of the ROS graph, whose emergency stop this is as well."""


class StopStatus(Struct, frozen=True):
    """The emergency stop: who pressed it last, who has and has not taken that back, how long ago, how often in all.

    ``presses`` counts those who joined in as well, for `release`; None of a robot that does not know that.
    """

    by: str = ""
    pressed: list[str] = []
    seconds: float = 0
    times: Count = 0
    history: list[str] = []
    presses: Count | None = None


RELEASE = b"false"
DIGITS = 12
"""Of a number that somebody says."""


def release(presses: int | None) -> bytes:
    """What the verb ``stop`` is asked by who ends the stop and has seen so many ``presses``: one that came since
    stays. None: of a robot that does not count them, which would take a number for a press."""
    return RELEASE if presses is None else b"%s %d" % (RELEASE, presses)


def released(data: bytes) -> tuple[bool, int | None]:
    """Whether the verb ``stop`` is asked to end the stop, and which presses the asker has seen, if he says so.
    Whatever is neither stops."""
    word, _, seen = data.partition(b" ")
    if word != RELEASE or (seen and not (seen.isdigit() and len(seen) <= DIGITS)):
        return False, None
    return True, int(seen) if seen else None


class RobotStatus(Struct, frozen=True):
    """The whole: what an answer of a newer robot has besides is ignored."""

    ros_node: str
    stopped: bool
    stop: StopStatus
    nodes: list[NodeStatus]
    drops: dict[str, Count] = {}
    trips: dict[str, TripsStatus] | UnsetType = UNSET
    """By topic, also where nobody commands it any more."""
    ros_domain: int | None = None
    beside: str | UnsetType = UNSET
    """What its agent cannot do for its safety, where that is a program beside the robot."""
    max_timed_command_age_s: float | UnsetType = UNSET
    """It asks what time commands were made, and how old they may be; 0: of any age."""
    counts_commands: bool | UnsetType = UNSET
    """It counts which commands come, and wants to be told how many were put (`CommandCount`)."""


def added(before: int, now: int) -> int:
    """How much a robot's count has grown; one that has been started again counts from none."""
    return now - before if now >= before else now


def counting_anew(status: RobotStatus) -> RobotStatus:
    """What is known of a robot that has been started again since: it counts from none."""
    return structs.replace(status, stop=structs.replace(status.stop, times=0), trips={}, drops={})


def tripped(status: RobotStatus) -> dict[str, TripsStatus]:
    """By topic: of an older robot those of the nodes that it has now."""
    if status.trips is not UNSET:
        return status.trips
    return {
        node.name: TripsStatus(node.deadman.trips, node.deadman.last)
        for node in status.nodes
        if node.deadman is not UNSET
    }


class TopicQos(Struct, frozen=True):
    """What a subscription to a topic has to ask for, or a publisher to offer, to match everybody there."""

    reliability: str = ""
    durability: str = ""


class Offered(Functionality, frozen=True, rename="camel"):
    """What a robot offers, with what the existing program does not tell: actions, and QoS by topic."""

    actions: dict[str, str] = field(default_factory=dict)
    qos: dict[str, TopicQos] = field(default_factory=dict)
    replay: bool | UnsetType = UNSET
    """It is a recording that is played: what it publishes was so once. Only agents on the mesh are told."""


class FollowRequest(Struct, frozen=True):
    """The data of a FunctionalityGetter request, if it has any: ``follow`` asks for every change as well."""

    follow: bool = False


class StatusRequest(Struct, frozen=True):
    """The data of the verb ``status``, if it has any: ``counts`` asks for a `StreamCount` of each topic on which the
    asker is registered, where it has changed since (``new``) or in any case (``all``)."""

    counts: Literal["", "new", "all"] = ""


class StreamCount(Struct, frozen=True):
    """Robot → one registrant, on the stream of a topic and behind its messages: how many of them were put for it since
    it registered. ``since`` says when that was, by a clock of the robot's own: it tells registrations apart."""

    manager: ClassVar[str] = "StreamCount"
    since: Count
    put: Count = 0


class CommandCount(StreamCount, frozen=True):
    """Gateway → a robot that counts commands (`RobotStatus.counts_commands`), behind those that one agent has sent to
    it by its id: how many samples of them were put since. Others must not get it."""

    manager: ClassVar[str] = "CommandCount"


class ControlRequest(Struct, frozen=True, rename="camel"):
    """Take control over a topic, release it, or give it to another agent (``to``, a headset unless ``toType``)."""

    manager: ClassVar[str] = "RobotControl"
    action: Literal["take", "release", "give"]
    topic: str
    to: AgentId = 0
    to_type: AgentType = 2


class ControlReply(Struct, frozen=True, rename="camel", omit_defaults=True):
    """Whether it was done, who holds control now, and why not."""

    done: bool
    holder: str = ""
    reason: str = ""
