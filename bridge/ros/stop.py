"""The emergency stop as an interface node: a publisher (type 2) of std_msgs/Bool that is always there.

True stops, false releases. So any existing headset program can stop the robot: it publishes to a topic, which crosses
the mesh at the highest priority and needs no registration. The state is on the same topic for ROS nodes and for
subscribed headsets, latched, and other agents on the same ROS graph share it (`shared_stop`).
"""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections.abc import Callable

from msgspec import UNSET, structs

from bridge.audit import who
from bridge.audit.notes import BEFORE
from bridge.ros.interface import InterfaceNode, Registrant, Robot
from bridge.ros.rules import names_agent
from bridge.ros.shared_stop import A_NODE, SharedStop, StopState
from bridge.ros.side import Publisher
from bridge.ros.stream import cdr_problem
from bridge.ros.topics import check_topic_type
from bridge.settings import WHO_STOPPED
from macs_zenoh.errors import Refused
from macs_zenoh.mesh import now_s
from macs_zenoh.protocol.keyexpr import type_name
from macs_zenoh.protocol.messages import ROS, AddNode, NodeType, node_name
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.rmw_zenoh.qos import Durability, Qos
from macs_zenoh.protocol.robot_state import NodeStatus

log = logging.getLogger("macs.ros")

STATES = {True: b"\x00\x01\x00\x00\x01", False: b"\x00\x01\x00\x00\x00"}
"""std_msgs/Bool in CDR."""
HEAR_S = 0.5
"""How long the stop waits, at the start, to hear whether it holds for the graph already."""
FIND_S = 0.15
"""How long in any case: an agent that was not found yet is not known to be unheard."""
LOOK_S = 0.01
PRESSED_SINCE = "the stop was pressed again after this release was sent"


class StopNode(InterfaceNode):
    """Stops and releases, from any thread. ``on_stop`` is called with who did it, once per stop."""

    NODE_TYPE = NodeType.PUBLISHER
    ROLE = "emergency stop"

    def __init__(self, robot: Robot, topic: str, on_stop: Callable[[str], None]) -> None:
        super().__init__(
            robot, AddNode(ROS, robot.agent_id, NodeType.PUBLISHER, node_name(topic), topic, "std_msgs/Bool")
        )
        self._on_stop = on_stop
        self._publisher: Publisher | None = None
        self._shared: SharedStop | None = None
        self._lock = threading.RLock()
        """Held while the stop changes and that is told: what is told last is what holds."""
        self.overtaken: Callable[[Message], bool] = lambda message: False
        """Whether a release was sent before its sender asked for a stop, which is faster."""
        self._pressed_at = -math.inf
        """When the last press was sent, whoever's it is."""

    @property
    def in_use(self) -> bool:
        return True

    def open(self) -> None:
        side = self.robot.session
        check_topic_type(side, self.topic, self.interface)
        kind = side.message(self.interface, self.topic)
        latched = Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)
        self._publisher = side.advertise(kind, self.request.tos_name, latched)
        self._shared = SharedStop(self.robot, self.topic, kind, self._adopt, lambda: self.press(A_NODE))
        self._shared.open()

    async def settle(self) -> None:
        """Hear from the other agents of this graph before anything is said, or passes."""
        assert self._shared is not None
        loop = asyncio.get_running_loop()
        begun = loop.time()
        while loop.time() < begun + HEAR_S:
            if not self._shared.unheard and loop.time() > begun + FIND_S:
                break
            await asyncio.sleep(LOOK_S)
        with self._lock:
            self._tell()

    def close(self) -> None:
        publisher, self._publisher = self._publisher, None
        if self._shared is not None:
            self._shared.close()
        if publisher is not None:
            publisher.close()

    def receive(self, message: Message) -> None:
        sender = Registrant.of(message)
        problem = cdr_problem(message.data, 5)
        if problem is not None:
            self.robot.drops.note("bad_cdr", f"{self.topic} from {sender}", problem)
            self.robot.tell_refused(message, self.topic, "bad_cdr", problem)
            return
        sent_at = now_s() - message.age_s  # before it waits for a press that is being carried out
        try:
            with self._lock:
                if not message.data[4] and (self.overtaken(message) or sent_at < self._pressed_at):
                    self.robot.drops.note("too_old", f"{self.topic} from {sender}", PRESSED_SINCE)
                    self.robot.tell_refused(message, self.topic, "too_old", PRESSED_SINCE)
                    return
                self.set(sender, message.data[4] != 0, sent_at=sent_at)
        except Refused as refusal:
            self.robot.drops.note("not_allowed", f"{self.topic} from {sender}", refusal.reason)
            self.robot.tell_refused(message, self.topic, "not_allowed", refusal.reason)

    def set(self, sender: Registrant, stop: bool, *, seen: int | None = None, sent_at: float | None = None) -> None:
        """Stop or release, ``sent_at`` of `now_s` if that is known; who releases has ``seen`` so many presses. Raises
        Refused when the settings do not allow it to this agent, or somebody has pressed it since."""
        try:
            with self._lock:
                if not stop and self.robot.stop.stopped and seen not in (None, self.robot.stop.presses):
                    raise Refused(f"{PRESSED_SINCE}, by {' and '.join(self.robot.stop.pressed)}")
                self._set(sender, stop, sent_at)
        except Refused as refusal:
            self.robot.audit.record("stop" if stop else "release", who(str(sender)), self.topic, refusal.reason)
            raise

    def _set(self, sender: Registrant, stop: bool, sent_at: float | None) -> None:
        if stop:
            if not self._names(self.robot.rules.settings.stop_allow, sender):
                raise Refused(f"{sender} may not stop this robot")
            self.press(str(sender), sent_at)
        elif self._names(self.robot.rules.settings.release_allow, sender):
            self.release(str(sender))
        elif WHO_STOPPED in self.robot.rules.settings.release_allow:
            self._take_back(str(sender))
        else:
            raise Refused(f"{sender} may not release this robot")

    def _names(self, patterns: list[str], sender: Registrant) -> bool:
        return names_agent(patterns, type_name(sender.type), sender.id, self.robot.group_of(sender))

    def press(self, by: str, sent_at: float | None = None) -> None:
        """Stop, latched. Again only makes releases from before it too old. ``sent_at`` None: until it is told."""
        with self._lock:
            before = self.robot.stop.changes
            try:
                if self.robot.stop.press(by, time.time()):
                    self._has_stopped()
                elif self.robot.stop.changes != before:
                    self.robot.audit.record("stop", who(by), self.topic, BEFORE)
                    self._tell()
            finally:
                self._pressed_at = max(self._pressed_at, now_s() if sent_at is None else sent_at)

    def release(self, by: str) -> None:
        """Let commands pass again, whoever stopped; the robot does nothing until one comes."""
        with self._lock:
            if self.robot.stop.release(by, time.time()):
                self._has_been_released()

    def left(self, agent: Registrant) -> None:
        with self._lock:
            if str(agent) in self.robot.stop.pressed:
                self.robot.stop.left(str(agent))
                self._tell()

    @property
    def shared_with(self) -> list[int]:
        """Ids of other robots whose agents work on this ROS graph."""
        return self._shared.others if self._shared is not None else []

    def status(self) -> NodeStatus:
        return structs.replace(super().status(), shared_with=self.shared_with or UNSET)

    def _take_back(self, by: str) -> None:
        with self._lock:
            stop = self.robot.stop
            if not stop.stopped:
                return
            if by not in stop.pressed:
                raise Refused(f"{by} may not release what {' and '.join(stop.pressed)} stopped")
            if stop.take_back(by, time.time()):
                self._has_been_released()
                return
            self._tell()
            raise Refused(f"{' and '.join(stop.pressed)} stopped it as well")

    def _adopt(self, state: StopState) -> None:
        with self._lock:
            stop = self.robot.stop
            was = stop.stopped
            before, presses = stop.changes, stop.presses
            if not stop.adopt(
                state.changes,
                state.pressed,
                state.by,
                time.time(),
                session=state.session,
                own=state.own,
                heard=state.heard,
            ):
                if stop.changes > max(before, state.changes):  # what was pressed here, they do not know
                    self._tell()
                return
            if stop.presses != presses:
                self._pressed_at = now_s()
            if stop.stopped and not was:
                self._has_stopped()
            elif was and not stop.stopped:
                self._has_been_released()
            else:
                self._tell()

    def _has_stopped(self) -> None:
        by = self.robot.stop.by
        try:
            self._on_stop(by)
        finally:
            self._tell()
        self.robot.audit.record("stop", who(by), self.topic)
        log.warning("emergency stop by %s; commands are refused until it is released", by)

    def _has_been_released(self) -> None:
        self._tell()
        self.robot.audit.record("release", who(self.robot.stop.by), self.topic)
        log.warning("emergency stop released by %s", self.robot.stop.by)

    def _tell(self) -> None:
        publisher, shared = self._publisher, self._shared
        if publisher is not None and shared is not None:
            try:
                shared.publish(publisher, STATES[self.robot.stop.stopped])
            finally:
                shared.tell()
