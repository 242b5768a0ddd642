"""Interface nodes by which a robot's topic goes to headsets (type 1).

Topic data crosses as bytes, never decoded: from the intake's thread straight into the mesh.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from bridge.ros import qos
from bridge.ros.counts import PutFor
from bridge.ros.gaps import Gaps
from bridge.ros.interface import Registrant, Robot
from bridge.ros.latched import Newcomers, Receivers, Told, message_of
from bridge.ros.side import Closable, Events, MessageType, OnRaw
from bridge.ros.stream import Fanout, StreamFraming
from bridge.ros.topics import TOO_LARGE, TopicNode, check_topic_type
from bridge.ros.unity_cdr import to_unity
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.messages import AddNode, NodeType, StreamData, encode_data
from macs_zenoh.protocol.rate import Rate
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.recovery import SILENT_S
from macs_zenoh.protocol.rmw_zenoh.qos import Qos
from macs_zenoh.protocol.robot_state import StreamCount
from macs_zenoh.protocol.trace import ROS_SENT, TAKEN

log = logging.getLogger("macs.ros")


class SubscriberNode(TopicNode):
    """Type 1: a robot's topic to its registrants, one frame per message whoever receives it."""

    NODE_TYPE = NodeType.SUBSCRIBER
    ROLE = "subscriber"

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        self._subscription: Closable | None = None
        self._profile = Qos()
        self._message: MessageType | None = None
        self._rate = RateLimit(self.rule.max_hz) if self.rule.max_hz else None
        self._rate_lock = threading.Lock()
        self._gaps = Gaps()
        self._max_frame_bytes = robot.rules.settings.max_frame_bytes
        self._loop = asyncio.get_running_loop()
        self._translate: Callable[[bytes], bytes] | None = None
        self._fanout_lock = threading.Lock()
        self._put_for = PutFor()
        self._fanout = self._to_registrants()
        self._is_latched = True
        """Whether publishers hold messages for late ones, and until they are known."""
        self._first: Receivers = frozenset()
        """Who was registered when the subscription was made that gets what is held for late ones."""
        self._told = Told()
        self._newcomers = Newcomers(
            robot.session, self._subscribe_also, self._publishers, self._profile_of, self._tell_newcomers
        )

    def registrants_changed(self) -> None:
        with self._fanout_lock:
            fanout = self._to_registrants()
            self._put_for.registered(fanout.receivers)
            self._fanout = fanout

    def tell_count(self, registrant: Registrant, *, again: bool) -> None:
        count = self._put_for.to_tell(registrant, again=again)
        if count is None:
            return
        framed = StreamFraming(self.metadata(StreamCount.manager), [registrant], self.robot.layout)
        try:
            self.robot.tell_stream(self.key.node_name, framed(encode_data(count)))
        except MacsError as error:
            log.debug("%s: %s is not told how much was put: %s", self.topic, registrant, error)

    def deregister(self, registrant: Registrant) -> None:
        super().deregister(registrant)
        self._first -= {registrant}
        self._told.forget(registrant)

    def welcome(self, registrant: Registrant) -> None:
        if registrant not in self._first:
            self._welcome([registrant])

    def _welcome(self, registrants: Iterable[tuple[int, int]]) -> None:
        if self.rule.durability != "volatile":
            self._newcomers.welcome(registrants)

    def open(self) -> None:
        self._message = message = self.robot.session.message(self.interface, self.topic)
        self._translate = partial(to_unity, message.unity) if message.unity is not None else None
        self.registrants_changed()  # before the first message comes
        check_topic_type(self.robot.session, self.topic, self.interface)
        self.robot.prioritise_stream(self.key.node_name, self.rule.priority)
        if self.robot.keep_stream(self.key.node_name, self.rule.cache):
            self.linger_s = SILENT_S
        self._subscribe(self._profile_of(self._publishers()))

    def other_types(self) -> set[str]:
        return self._others(publishers_first=True)

    def close(self) -> None:
        self._newcomers.close()
        self._unsubscribe()

    def _unsubscribe(self) -> None:
        subscription, self._subscription = self._subscription, None
        if subscription is not None:
            subscription.close()

    def retire(self) -> None:
        self.robot.keep_stream(self.key.node_name, None)

    def receive(self, message: Message) -> None:
        self.robot.drops.note("no_node", self.key.node_name, "data for a node that only sends")

    def _to_registrants(self) -> Fanout:
        return Fanout(
            self.metadata(StreamData.manager),
            frozenset(self.registrants),
            frozenset(self.unity),
            self.robot.layout,
            translate=self._translate,
        )

    # -- in the ROS thread ---------------------------------------------------------------------------------------

    def _publishers(self) -> list[Qos]:
        return [publisher.qos for publisher in self.robot.session.publishers(self.topic)]

    def _profile_of(self, publishers: Iterable[Qos]) -> Qos:
        offered = list(publishers)
        profile = qos.for_subscription(offered, qos.depth_of(self.request.buffer_size))
        return qos.for_each_of(len(offered), qos.overridden(profile, self.rule))

    def _subscribe_also(self, profile: Qos, on_raw: OnRaw, events: Events | None) -> Closable:
        """For newcomers."""
        assert self._message is not None
        return self.robot.session.subscribe(self._message, self.request.tos_name, on_raw, profile, events)

    def _subscribe(self, profile: Qos) -> None:
        self._first = self._fanout.receivers if qos.is_latched(profile) else frozenset()
        # some middlewares tell nothing of these; then the QoS stays as it is
        events = Events(self._publisher_matched, self._publisher_incompatible, self._lost)
        self._subscription = self._subscribe_also(profile, self._pass_on, events)
        self._profile = profile

    # -- in the thread of the intake -----------------------------------------------------------------------------

    def _pass_on(self, cdr: bytes, info: Mapping[str, Any]) -> None:
        """One message with what ROS knows about it."""
        if self.robot.tracing is not None and self.robot.tracing.marks:
            self.robot.tracing.note((ROS_SENT, info["source_timestamp"]), (TAKEN, time.time_ns()))
        if self._gaps.take(info["publication_sequence_number"]):
            self._loop.call_soon_threadsafe(self._loop.call_later, self._gaps.SETTLE_S, self._tell_gaps)
        if self._is_latched:
            fanout = self._fanout
            receivers = self._told.to_tell(message_of(info), fanout.receivers)
            if receivers != fanout.receivers:
                self._put(cdr, fanout.only(receivers))
                return
        self._publish(cdr)

    def _tell_newcomers(self, cdr: bytes, info: Mapping[str, Any], newcomers: Receivers) -> bool:
        """A message that the topic's publishers hold for late ones."""
        fanout = self._fanout
        receivers = self._told.to_tell(message_of(info), newcomers & fanout.receivers)
        if receivers:
            self._put(cdr, fanout.only(receivers))
        return bool(receivers)

    def _publish(self, cdr: bytes) -> None:
        if self._rate is None:
            self._put(cdr)
            return
        now = time.monotonic()
        with self._rate_lock:
            waits = self._rate.waiting
            due = self._rate.offer(cdr, now)
        if due is None:
            self._put(cdr)
        elif not waits:
            self._loop.call_soon_threadsafe(self._loop.call_later, due - now, self._put_latest)

    def _put_latest(self) -> None:
        """What waited for its time, on the loop."""
        if self._rate is not None and self._subscription is not None:
            with self._rate_lock:
                latest = self._rate.take(time.monotonic())
            if latest is not None:
                self._put(latest)

    def _put(self, cdr: bytes, fanout: Fanout | None = None) -> None:
        self.carried.count(len(cdr))
        fanout = fanout or self._fanout
        is_whole = True
        try:
            for frame in fanout(cdr):
                if len(frame) > self._max_frame_bytes:
                    self._note_too_large(len(frame))
                    is_whole = False
                    continue
                self.robot.publish_stream(self.key.node_name, frame)
            if is_whole:  # behind it: a count must not overtake what it counts
                self._put_for.add(fanout.receivers)
        except MacsError as error:
            self.robot.drops.note("failed", self.topic, str(error))

    def _note_too_large(self, size: int) -> None:
        reason = f"a message makes a frame of {size} bytes, more than max_frame_bytes ({self._max_frame_bytes})"
        self.robot.drops.note(TOO_LARGE, self.topic, reason)
        self._loop.call_soon_threadsafe(self.tell_registrants, TOO_LARGE, reason)

    def _publisher_matched(self, count: int, change: int) -> None:
        self._gaps.publishers(count)
        if change > 0:
            self._is_latched = True  # it may be
            self.robot.session.submit(self._follow)

    def _publisher_incompatible(self) -> None:
        self.robot.session.submit(self._follow)

    def _follow(self) -> None:
        """Adopt the QoS of publishers that came after us."""
        publishers = self._publishers()
        if self._subscription is None or not publishers:
            return
        profile = self._profile_of(publishers)
        self._is_latched = any(map(qos.is_latched, publishers))
        if not qos.same(profile, self._profile):
            log.info("%s: its publishers changed, subscribing again with %s", self.topic, _describe(profile))
            self._unsubscribe()
            self._subscribe(profile)
        elif self._is_latched and not qos.is_latched(profile):
            # one that does not latch is among them, so what a new one holds does not come by itself
            self._welcome(self._fanout.receivers)

    def _lost(self, count: int) -> None:
        """ROS itself counts what the network lost, not what it threw away for want of room."""
        if not self._gaps.counting:
            self._note_lost(count)

    def _tell_gaps(self) -> None:
        if missing := self._gaps.missing():
            self._note_lost(missing)

    def _note_lost(self, count: int) -> None:
        text = "ROS lost messages before they were taken; a larger buffer size may help"
        self.robot.drops.note("lost_in_ros", self.topic, text, count)


class RateLimit:
    """At most ``max_hz`` messages per second; of those that come too soon only the latest waits. Pure."""

    def __init__(self, max_hz: float) -> None:
        self._period_s = 1 / max_hz
        self._pace = Rate(max_hz)
        self._latest: bytes | None = None

    @property
    def waiting(self) -> bool:
        """Whether a message waits for its time."""
        return self._latest is not None

    def offer(self, message: bytes, now: float) -> float | None:
        """None: send it now. Otherwise it waits in place of an older one, until the time that is returned."""
        if self._latest is None and self._pace.allows(now):
            self._sent(now)
            return None
        self._latest = message
        return self._pace.due

    def take(self, now: float) -> bytes | None:
        """The message that waits, to be sent now."""
        latest, self._latest = self._latest, None
        if latest is not None:
            self._sent(now)
        return latest

    def _sent(self, now: float) -> None:
        """Keep the pace: a message that was a little late does not delay all that follow."""
        due = self._pace.due
        self._pace.take(1, due if now - due < self._period_s else now)


def _describe(profile: Qos) -> str:
    return f"{profile.reliability.name.lower()}, {profile.durability.name.lower()}".replace("_", " ")
