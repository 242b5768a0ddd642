"""Interface nodes by which headsets publish to a robot's topic (type 2), and what all nodes for topics have in common.

Topic data crosses as bytes, never decoded: from the thread that brought it from the mesh, or the loop, straight into a
publisher.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections.abc import Iterable
from functools import partial

from msgspec import UNSET, UnsetType, structs

from bridge.audit import who
from bridge.ros import qos
from bridge.ros.alarms import Alarm
from bridge.ros.carried import Carried
from bridge.ros.interface import InterfaceNode, Registrant, Robot
from bridge.ros.rules import DEFAULT_HOLD_S
from bridge.ros.safety import Control, DeadMan
from bridge.ros.side import CutOff, MessageType, Other, Publisher, Side
from bridge.ros.stream import cdr_problem
from bridge.ros.types import InterfaceName
from bridge.ros.unity_cdr import TooManyParts, to_ros
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.messages import AddNode, NodeType
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import ControlStatus, DeadManStatus, NodeStatus
from macs_zenoh.timeouts import within

log = logging.getLogger("macs.ros")


TOO_LARGE = "too_large"
STOP_AGAIN_S = 0.05
"""After so long a stop message that ROS did not take is published again."""
STOP_TIMES = 15
"""As long as a publisher that is not needed any more is kept for it."""
CUT_OFF_S = 60.0
"""As long as that it is published again where the way to the robot's nodes is lost: they may be moving still."""


class TopicNode(InterfaceNode):
    """What both kinds of topic nodes have in common."""

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        self.carried = Carried()

    def status(self) -> NodeStatus:
        return structs.replace(super().status(), carried=self.carried.status())

    def _others(self, *, publishers_first: bool) -> set[str]:
        """The types at the other end of the topic, or without one at ours; none when ours is among them."""
        side, topic = self.robot.session, self.topic
        publishers = types_of_others(side, side.publishers(topic))
        subscriptions = types_of_others(side, side.subscriptions(topic))
        found = (publishers or subscriptions) if publishers_first else (subscriptions or publishers)
        return set() if str(self.interface) in found else found


class PublisherNode(TopicNode):
    """Type 2: what agents send to a robot's topic, as far as safety lets it pass."""

    NODE_TYPE = NodeType.PUBLISHER
    ROLE = "publisher"

    MATCH_S = 0.5
    """How long a new publisher waits for the subscriptions that exist to find it."""
    LINGER_S = 1.0
    """How long a publisher stays after its stop message: destroyed at once, it takes unread messages with it."""

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        if self.rule.read_only:
            raise Refused(f"headsets may only read {self.topic} on this robot")
        self.control = Control(self.rule.hold_s or DEFAULT_HOLD_S) if self.rule.exclusive else None
        if self.control is not None:
            self.control.on_taken = lambda agent: robot.audit.record("control_taken", who(str(agent)), self.topic)
        self.deadman = DeadMan(self.rule.deadman_s) if self.rule.deadman_message is not None else None
        if self.deadman is not None:
            self.deadman.on_trip = partial(robot.trips.note, self.topic)
        self._stop_cdr = b""
        self._stopped_at = -math.inf
        self._watch: Alarm | None = None
        self._retired = False
        self._publisher: Publisher | None = None
        self._message: MessageType | None = None
        self._expected = 0
        self._matched = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self.lock = threading.RLock()
        """Held while something is judged and published: no command that came before a stop message may follow it."""

    def open(self) -> None:
        side = self.robot.session
        message = side.message(self.interface, self.topic)
        self._message = message
        if self.rule.deadman_message is not None:
            self._stop_cdr = self._stop_message(message)
        check_topic_type(side, self.topic, self.interface)
        subscriptions = [subscription.qos for subscription in side.subscriptions(self.topic)]
        profile = qos.for_publisher(
            subscriptions, qos.depth_of(self.request.buffer_size), latched=self.request.is_latched
        )
        profile = qos.overridden(profile, self.rule)
        self._expected = len(subscriptions)
        # where nothing matches, as with some middlewares, the time decides
        self._publisher = side.advertise(message, self.request.tos_name, profile, self._subscription_matched)

    def _stop_message(self, message: MessageType) -> bytes:
        try:
            return message.filled(self.rule.deadman_message or {}, "deadman_message")
        except Refused as refusal:  # the headset cannot mend it
            self._loop.call_soon_threadsafe(self.robot.drops.note, "wrong_settings", self.topic, refusal.reason)
            raise

    def other_types(self) -> set[str]:
        return self._others(publishers_first=False)

    async def settle(self) -> None:
        """Let the subscriptions that exist find the new publisher: what is published before that, ROS loses."""
        if self._expected:
            with contextlib.suppress(asyncio.TimeoutError):
                await within(self._matched.wait(), self.MATCH_S)

    def _subscription_matched(self, count: int) -> None:
        if count >= self._expected:
            self._loop.call_soon_threadsafe(self._matched.set)

    def retire(self) -> None:
        with self.lock:
            self._retired = True
            if self._watch is not None:
                self._watch.cancel()
            if self.deadman is not None and self.deadman.disarm("the node was removed"):
                self._publish_stop(self.deadman.why)

    def close(self) -> None:
        with self.lock:  # somebody may be publishing its stop message
            publisher, self._publisher = self._publisher, None
        if publisher is not None:
            self._end(publisher)

    def _end(self, publisher: Publisher) -> None:
        if self._stopped_at + self.LINGER_S > time.monotonic():
            self.robot.session.later(self.LINGER_S, lambda: self._end(publisher))
        else:
            publisher.close()

    def receive(self, message: Message) -> None:
        of = self._message
        try:  # before the lock, for which a stop message may wait
            cdr = to_ros(of.unity if of else None, message.data, self.robot.rules.settings.max_message_parts)
        except TooManyParts as error:
            self._refuse(message, TOO_LARGE, f"refused {len(message.data)} bytes for {self.interface}: {error}")
            return
        problem = of.problem(cdr) if of else cdr_problem(cdr)
        with self.lock:
            refusal = self._refusal(message, problem)
            if refusal is None:
                if self._publish(cdr, self._publisher) is None:
                    self.carried.count(len(cdr))
                    if self.deadman is not None:
                        self.deadman.command(Registrant.of(message), time.monotonic() - message.age_s)
                        if self._watch is None:
                            self._watch_silence()
                return
        self._refuse(message, *refusal)

    def _refuse(self, message: Message, name: str, why: str) -> None:
        self.robot.drops.note(name, f"{self.topic} from {Registrant.of(message)}", why)
        self.robot.tell_refused(message, self.topic, name, why)

    def refused(self, message: Message, reason: str) -> None:
        self.robot.tell_refused(message, self.topic, "not_allowed", reason)

    def _refusal(self, message: Message, problem: str | None) -> tuple[str, str] | None:
        """The name of the drop and why, when a message may not pass now. ``problem``: of its bytes."""
        if self._retired:
            return "no_node", "it was removed in this moment"
        if problem is not None:
            return "bad_cdr", f"refused {len(message.data)} bytes for {self.interface}: {problem}"
        if self.held:
            no_stop = self.robot.no_stop
            return ("no_stop", no_stop) if no_stop else ("stopped", "the emergency stop holds")
        if self.control is not None and not self.control.take(Registrant.of(message), time.monotonic()):
            return "not_in_control", f"{self.control.holder(time.monotonic())} has control"
        return None

    def _publish(self, cdr: bytes, publisher: Publisher | None, *, again: bool = False) -> Exception | None:
        """What failed, counted unless it is tried ``again`` over a way that is lost."""
        try:
            assert publisher is not None
            publisher.publish(cdr)
        except Exception as error:  # noqa: BLE001 - the middleware's, whatever it is
            if not (again and isinstance(error, CutOff)):
                self.robot.drops.note("failed", self.topic, f"ROS did not publish: {error}")
            return error
        return None

    # -- safety, from any thread ---------------------------------------------------------------------------------

    def left(self, agent: Registrant) -> None:
        with self.lock:
            if self.control is not None and self.control.release(agent):
                self.robot.audit.record("control_released", who(str(agent)), self.topic, "it left")
            if self.deadman is not None and self.deadman.left(agent):
                self._publish_stop(self.deadman.why, logging.INFO)  # as it does every day

    def fell_asleep(self, agent: Registrant) -> None:
        """Control it keeps as long as it would without a command."""
        with self.lock:
            if self.deadman is not None and self.deadman.left(agent, "has lost its connection"):
                self._publish_stop(self.deadman.why)

    def cut_off(self) -> None:
        with self.lock:
            if self.deadman is not None and self.deadman.disarm("the mesh is lost"):
                self._publish_stop(self.deadman.why)

    def deregister(self, registrant: Registrant) -> None:
        super().deregister(registrant)
        self.left(registrant)

    def emergency_stop(self, by: str) -> None:
        if self.deadman is None:  # nothing to say, and no reason to wait for what is published now
            return
        with self.lock:  # whether commands were under way or not
            self.deadman.disarm(f"emergency stop by {by}")
            self._publish_stop(f"emergency stop by {by}")

    def _watch_silence(self) -> None:
        """Look when the dead-man may be due; a command in between costs nothing."""
        if self.deadman is None:
            return
        with self.lock:
            self._watch = None
            if self.deadman.tick(time.monotonic()):
                self._publish_stop(self.deadman.why)
            elif (deadline := self.deadman.deadline()) is not None:
                self._watch = self.robot.alarms.at(deadline, self._watch_silence)

    def _publish_stop(self, why: str, level: int = logging.WARNING) -> None:
        if self._publisher is not None:
            self._say_stop(self._publisher, why, level)

    def _say_stop(self, publisher: Publisher, why: str, level: int, times: int = 1, until: float = 0.0) -> None:
        """Again when ROS does not take it, also while the publisher is closing: nothing else would."""
        if times > 1 and self.deadman is not None and self.deadman.commander is not None:
            return  # it is commanded anew
        self._stopped_at = now = time.monotonic()
        failed = self._publish(self._stop_cdr, publisher, again=times > 1)
        until = until or now + CUT_OFF_S
        if failed is None:
            log.log(level, "%s: %s; published the stop message", self.topic, why)
        elif times < STOP_TIMES or (isinstance(failed, CutOff) and now < until):

            def say() -> None:
                with self.lock:
                    self._say_stop(publisher, why, level, times + 1, until)

            self.robot.alarms.at(now + STOP_AGAIN_S, say)
        else:
            log.error("%s: %s; the stop message could not be published", self.topic, why)

    def status(self) -> NodeStatus:
        return structs.replace(super().status(), control=self._control_status(), deadman=self._deadman_status())

    def _control_status(self) -> ControlStatus | UnsetType:
        if self.control is None:
            return UNSET
        now = time.monotonic()
        holder = self.control.holder(now)
        left_s = round(self.control.seconds_left(now), 1) if holder else 0
        return ControlStatus(str(holder) if holder else None, round(self.control.seconds_held(now), 1), left_s)

    def _deadman_status(self) -> DeadManStatus | UnsetType:
        if self.deadman is None:
            return UNSET
        commander = self.deadman.commander
        return DeadManStatus(
            self.deadman.silence_s, str(commander) if commander else None, self.deadman.trips, self.deadman.why
        )


def types_of_others(side: Side, endpoints: Iterable[Other]) -> set[str]:
    """The types of these endpoints as far as they are other nodes'."""
    return {endpoint.type for endpoint in endpoints if endpoint.node != side.full_name}


def check_topic_type(side: Side, topic: str, interface: InterfaceName) -> None:
    """Raise Refused when the topic exists and carries another type. In the ROS thread."""
    interface.check(topic, {endpoint.type for endpoint in (*side.publishers(topic), *side.subscriptions(topic))})
