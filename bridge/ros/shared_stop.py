"""One emergency stop for all robot agents of a ROS graph, and for ROS nodes that stop.

Several agents on one graph drive the same robot, so a stop that one of them heard must hold for all. Each tells its
state on a hidden topic beside the stop's own, latched, so that one that comes later knows it as well. The state has a
number that grows with each change; the highest is adopted, so nothing goes round in circles, and of two changes at
once the stop wins (`safety.EmergencyStop.adopt`).

On the stop's own topic any ROS node can stop the robot, as a button does: true. Its false releases nothing, that is a
right of agents on the mesh. The node need not stay: one that publishes and ends has stopped the robot.

Whatever quality of service it offers: ROS brings a subscription that asks for more than a publisher offers nothing at
all, so there is one that asks for what was said before, one for all that is said, and one for what comes.

What agents publish there themselves is no button's. An agent knows its own messages by the time at which they were
published. Of other agents on the graph it only knows that they are there: as long as the topic has more publishers
than the graph has agents, a true can be a button's; if not, it is one when no agent has said why within a moment.
"""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
from msgspec import Struct

from bridge.ros.interface import Robot
from bridge.ros.side import Closable, MessageType, Publisher
from bridge.ros.types import InterfaceName
from macs_zenoh.protocol.rmw_zenoh.cdr import read_text, written_text
from macs_zenoh.protocol.rmw_zenoh.qos import Durability, Qos, Reliability

log = logging.getLogger("macs.ros")

AGENTS = "/_agents"
"""After the topic of the stop: where agents tell each other. ROS hides it, and so do our rules."""
STATE_BYTES = 16 << 10
KNOWN = 64
"""Agents of one graph that are remembered."""
A_NODE = "a ROS node"
EXPLAINED_S = 0.1
"""How long before or after a message on the topic of the stop another agent may say that it was its own."""
UNREAD = 256
"""More messages of our own do not wait to be read."""
ASKED = (
    Qos(depth=KNOWN, durability=Durability.TRANSIENT_LOCAL),
    Qos(depth=KNOWN),
    Qos(depth=KNOWN, reliability=Reliability.BEST_EFFORT),
)
"""What is asked of publishers on the topic of the stop: what they hold; reliable; anything."""


PRESSED = b"\x01"
"""The data of a message that stops, behind its CDR header."""


class StopState(Struct, frozen=True):
    """What one agent says of the stop."""

    session: str
    """A new one with each start of the program."""
    robot: int
    changes: int
    pressed: list[str]
    by: str
    own: dict[str, int] = {}
    heard: dict[str, int] | None = None
    """None: of an agent that does not say so."""


class SharedStop:
    """The part of the emergency stop that other ROS nodes see and set.

    ``on_state`` is called with what another agent says, ``on_press`` when a ROS node stops; in the thread of the
    intake.
    """

    def __init__(
        self,
        robot: Robot,
        topic: str,
        kind: MessageType,
        on_state: Callable[[StopState], None],
        on_press: Callable[[], None],
    ) -> None:
        self._robot = robot
        self._topic = topic
        self._kind = kind
        self._on_state = on_state
        self._on_press = on_press
        self._agents: dict[str, int] = {}
        self._own: deque[list[float]] = deque(maxlen=UNREAD)
        """From when to when each of our own messages was published, in ns since the epoch."""
        self._heard: deque[int] = deque(maxlen=UNREAD)
        """When presses were published that have been heard: each comes by several subscriptions."""
        self._stopped_at = -math.inf
        """When another agent said last that the robot is stopped, and was believed."""
        self._publisher: Publisher | None = None
        self._subscriptions: list[Closable] = []

    def open(self) -> None:
        """Tell, and listen. In the ROS thread. Raises Refused."""
        side = self._robot.session
        text = side.message(InterfaceName.parse("std_msgs/String", "msg"), self._topic + AGENTS)
        self._publisher = side.advertise(text, self._topic + AGENTS, _latched(1))
        self._subscriptions = [
            side.subscribe(text, self._topic + AGENTS, self._told, _latched(KNOWN)),
            *(side.subscribe(self._kind, self._topic, self._said, asked) for asked in ASKED),
        ]

    def close(self) -> None:
        """In the ROS thread."""
        publisher, self._publisher = self._publisher, None
        subscriptions, self._subscriptions = self._subscriptions, []
        for subscription in subscriptions:
            subscription.close()
        if publisher is not None:
            publisher.close()

    def publish(self, publisher: Publisher, state: bytes) -> None:
        """Publish on the topic of the stop; our subscription to it knows that this is our own. From any thread."""
        published: list[float] = [time.time_ns(), math.inf]
        if state[4:5] == PRESSED:  # nothing else is taken for a press, and a press that comes meanwhile is a press
            self._own.append(published)
        try:
            publisher.publish(state)
        finally:
            published[1] = time.time_ns()

    def tell(self) -> None:
        """Tell the state as it is now. From any thread."""
        publisher, stop = self._publisher, self._robot.stop
        if publisher is not None:
            state = StopState(
                stop.session, self._robot.agent_id, stop.changes, stop.pressed, stop.by, stop.own, stop.heard
            )
            publisher.publish(written_text(msgspec.json.encode(state)))

    @property
    def unheard(self) -> int:
        """Of how many agents on this graph nothing has been heard yet. From any thread."""
        return max(0, int(self._robot.session.count_publishers(self._topic + AGENTS)) - 1 - len(self._agents))

    @property
    def others(self) -> list[int]:
        """Ids of other robots whose agents work on this graph."""
        if self._publisher is None or self._robot.session.count_publishers(self._topic + AGENTS) < 2:
            return []
        return sorted(set(self._agents.values()) - {self._robot.agent_id})

    # -- in the thread of the intake -----------------------------------------------------------------------------

    def _told(self, cdr: bytes, _info: Mapping[str, Any]) -> None:
        try:
            if len(cdr) > STATE_BYTES:
                raise msgspec.DecodeError(f"{len(cdr)} bytes")
            state = msgspec.json.decode(read_text(cdr), type=StopState)
        except (ValueError, msgspec.MsgspecError, RecursionError) as error:
            self._robot.drops.note("bad_stop_state", self._topic + AGENTS, f"this is no state of an agent: {error}")
            return
        if state.session == self._robot.stop.session:
            return
        self._meet(state)
        self._on_state(state)
        if state.pressed and self._robot.stop.stopped:  # what says less than is known here explains nothing
            self._stopped_at = time.monotonic()

    def _meet(self, state: StopState) -> None:
        if state.session in self._agents:
            return
        if len(self._agents) >= KNOWN:
            del self._agents[next(iter(self._agents))]
        self._agents[state.session] = state.robot
        if state.robot != self._robot.agent_id:
            log.warning(
                "the agent of robot %d works on this ROS graph too: each drives what the other drives, and a stop of"
                " one holds for both; give each robot a ROS_DOMAIN_ID of its own",
                state.robot,
            )

    def _said(self, cdr: bytes, info: Mapping[str, Any]) -> None:
        published_ns = info["source_timestamp"]
        if bytes(cdr[4:5]) != PRESSED or self._is_own(published_ns) or published_ns in self._heard:
            return
        self._heard.append(published_ns)
        count = self._robot.session.count_publishers
        agents = count(self._topic + AGENTS)
        if agents <= 1:
            self._on_press()
        elif not self._robot.stop.stopped:
            if count(self._topic) > agents:
                self._on_press()
            else:  # of a node that has ended, or of another agent
                self._robot.alarms.at(time.monotonic() + EXPLAINED_S, self._pressed_by_nobody)

    def _pressed_by_nobody(self) -> None:
        explained = time.monotonic() - self._stopped_at <= 2 * EXPLAINED_S
        if not explained and not self._robot.stop.stopped:
            self._on_press()

    def _is_own(self, published_ns: int) -> bool:
        return any(begun <= published_ns <= done for begun, done in list(self._own))


def _latched(depth: int) -> Qos:
    return Qos(depth=depth, durability=Durability.TRANSIENT_LOCAL)
