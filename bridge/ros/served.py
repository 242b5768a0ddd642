"""Interface nodes for services of headsets, which ROS nodes on the robot call (type 4).

They have deadlines, and many calls can be open at once: nothing waits in the ROS thread. How a call that fails is told
is written in docs/robot.md.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from typing import Any, NamedTuple

from msgspec import structs

from bridge.ros.interface import InterfaceNode, Registrant, Robot
from bridge.ros.servers import check_service_type
from bridge.ros.services import BURST
from bridge.ros.side import NotOfType, Server, ServiceType, first_line
from bridge.ros.unity_cdr import TooManyParts, readable, to_unity
from macs_zenoh.errors import Refused, WireError
from macs_zenoh.protocol.messages import AddNode, CallFailure, NodeType, decode_data
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import NodeStatus

PACE_FAILURES_S = 0.005
REQUEST_IDS = 1 << 31
"""The C# program counts in an int."""


class OpenCall(NamedTuple):
    """A ROS node's call that a headset has not answered yet."""

    header: Any
    timer: asyncio.TimerHandle


class ServiceNode(InterfaceNode):
    """Type 4: a service that a headset runs, for ROS nodes on the robot. One registrant.

    ROS has no word for a call that failed. The caller gets a response with every field zero (`MessageType.failure`)
    at the deadline, when the headset says that it failed, and when the headset leaves.
    """

    NODE_TYPE = NodeType.SERVICE
    ROLE = "service"
    INTERFACE = "srv"
    MAX_REGISTRANTS = 1

    LINGER_S = 0.25
    """How long a service stays after its last response: destroyed at once, it takes unread responses with it."""

    WATCH_S = 1.0
    """Pause between looks for another server."""

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        self._service: Server | None = None
        self._types: ServiceType | None = None
        self._deadline_s = robot.rules.call_timeout_s(self.topic)
        self._open_calls: dict[int, OpenCall] = {}
        self._next_request = 0
        self._failed: deque[tuple[Any, str]] = deque()
        self._answered_at = -math.inf
        self._closing = self._ending = False
        self._watching: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()

    def check_same(self, request: AddNode) -> None:
        super().check_same(request)
        if request.node_name != self.key.node_name:  # calls go out under one name
            raise Refused(f"{self.topic} is registered as {self.request.tos_name}; use that name")

    def open(self) -> None:
        side = self.robot.session
        self._types = types = side.service(self.interface, self.topic)
        types.response.failure("", self.rule.error_response, "error_response")
        check_service_type(side, self.topic, self.interface)
        if others := side.servers_elsewhere(self.topic):
            raise Refused(f"{self.topic} is served by {' and '.join(others)} on this robot")
        self._service = side.serve(types, self.request.tos_name, self._take)

    async def settle(self) -> None:
        self._watch()

    def _watch(self) -> None:
        """ROS tells nobody when a service appears. A node of the robot that begins to serve this one wins: a call goes
        to both, and the headset's answer may be the first."""
        self._watching = self._loop.call_later(self.WATCH_S, self.robot.session.submit, self._look_for_others)

    def _look_for_others(self) -> None:
        """In the ROS thread."""
        side = self.robot.session
        if self._service is None or self._closing:
            return
        others = side.servers_elsewhere(self.topic) if side.count_servers(self.topic) > 1 else []
        self._loop.call_soon_threadsafe(self._looked, others)

    def _looked(self, others: list[str]) -> None:
        if not others:
            self._watch()
            return
        who = " and ".join(map(str, self.registrants)) or "the headset"
        text = f"{' and '.join(others)} serves it now; the service of {who} is withdrawn"
        self.robot.drops.note("withdrawn", self.topic, text)
        self.unused()

    def retire(self) -> None:
        if self._watching is not None:
            self._watching.cancel()
        self._fail_open()

    def stays_asleep(self, agent: Registrant) -> None:
        if agent in self.registrants:
            self._fail_open()

    def _fail_open(self) -> None:
        for request_id in list(self._open_calls):
            self._fail(request_id, f"the headset that serves {self.topic} has left")

    def close(self) -> None:
        self._closing = True
        if not self._failed:
            self._end_when_read()

    def _end_when_read(self) -> None:
        """Destroy the service once what it has answered is taken; who calls it until then hears that it is over."""
        if self._ending:
            return
        self._ending = True
        wait_s = self._answered_at + self.LINGER_S - time.monotonic()
        if wait_s > 0:
            self.robot.session.later(wait_s, self._destroy)
        else:
            self._destroy()

    def _destroy(self) -> None:
        service, self._service = self._service, None
        if service is not None:
            service.close()

    def receive(self, message: Message) -> None:
        """The headset's answer."""
        sender, request_id = Registrant.of(message), message.metadata.request_id
        if sender not in self.registrants:
            self.robot.drops.note("late_answer", self.topic, f"an answer from {sender}, which does not serve it")
            return
        call = self._open_calls.get(request_id)
        if call is None:
            self.robot.drops.note("late_answer", self.topic, f"an answer from {sender} after the deadline")
            return
        # an existing headset may copy the manager of the request; CDR never begins with a brace
        if message.metadata.message_manager == CallFailure.manager and message.data[:1] == b"{":
            try:
                reason = decode_data(CallFailure, message.data).reason
            except WireError:
                reason = "it did not say why"
            self._fail(request_id, f"{sender} failed: {reason}")
            return
        assert self._types is not None
        try:
            most, expected = self.robot.rules.settings.max_message_parts, self._types.response
            answer = readable(expected.unity, expected.parts, message.data, most)
        except TooManyParts as error:
            self._bad_answer(request_id, sender, f"{len(message.data)} bytes are too much: {error}")
            return
        problem = expected.problem(answer)
        if problem is not None:
            self._bad_answer(request_id, sender, problem)
            return
        self._close_call(request_id)
        self.robot.session.submit(lambda: self._send(request_id, sender, call.header, answer))

    def status(self) -> NodeStatus:
        return structs.replace(super().status(), open_calls=len(self._open_calls))

    def _ask(self, request: bytes, header: Any) -> None:
        """Pass a ROS node's request to the headset. On the loop."""
        request_id = self._next_request
        self._next_request = (request_id + 1) % REQUEST_IDS
        timer = self._loop.call_later(self._deadline_s, self._expire, request_id)
        self._open_calls[request_id] = OpenCall(header, timer)
        registrant = next(iter(self.registrants), None)
        if registrant is None or len(self._open_calls) > self.robot.rules.settings.max_calls:
            self._fail(request_id, f"{self.topic} takes no calls now")
            return
        if registrant in self.unity:
            request = to_unity(self._types.request.unity if self._types else None, request)
        if (size := len(request)) > (limit := self.robot.rules.settings.max_frame_bytes):
            self.robot.drops.note("too_large", self.topic, f"a request of {size} bytes, more than {limit}")
            self._fail(request_id, f"the request has {size} bytes, more than {limit}")
            return
        # we understand a failure; receivers look at the node name first
        self.robot.send(registrant, self.metadata(CallFailure.manager, request_id), request)

    def _expire(self, request_id: int) -> None:
        who = " and ".join(map(str, self.registrants)) or "the headset"
        self.robot.drops.note("call_timeout", self.topic, f"no answer from {who} within {self._deadline_s:g} s")
        self._fail(request_id, f"no answer from {who} within {self._deadline_s:g} s")

    def _bad_answer(self, request_id: int, sender: Registrant, problem: str) -> None:
        self.robot.drops.note(
            "bad_cdr", f"{self.topic} from {sender}", f"its answer is no {self.interface}: {problem}"
        )
        self._fail(request_id, f"the answer of {sender} is no {self.interface}: {problem}")

    def _close_call(self, request_id: int) -> OpenCall | None:
        call = self._open_calls.pop(request_id, None)
        if call is not None:
            call.timer.cancel()
        return call

    def _fail(self, request_id: int, reason: str) -> None:
        call = self._close_call(request_id)
        if call is not None:
            self.robot.session.submit(lambda: self._send_failure(call.header, reason))

    # -- in the ROS thread ---------------------------------------------------------------------------------------

    def _take(self, request: bytes, header: Any) -> None:
        self._loop.call_soon_threadsafe(self._ask, request, header)

    def _send(self, request_id: int, sender: Registrant, header: Any, answer: bytes) -> None:
        try:
            self._answer(answer, header)
        except NotOfType as problem:
            about = f"{self.topic} from {sender}"
            self._loop.call_soon_threadsafe(
                self.robot.drops.note, "bad_cdr", about, f"its answer is no {self.interface}: {problem}"
            )
            self._send_failure(header, f"the answer of {sender} is no {self.interface}: {problem}")

    def _send_failure(self, header: Any, reason: str) -> None:
        self._failed.append((header, reason))
        if len(self._failed) == 1:
            self._send_failures()

    def _send_failures(self) -> None:
        """A few at a time: many calls fail at once when a headset leaves."""
        assert self._types is not None
        for header, reason in list(self._failed)[:BURST]:
            values = self.rule.error_response
            self._answer(self._types.response.failure(reason, values, "error_response"), header)
        for _ in range(min(BURST, len(self._failed))):
            self._failed.popleft()
        if self._failed:
            self.robot.session.later(PACE_FAILURES_S, self._send_failures)
        elif self._closing:
            self._end_when_read()

    def _answer(self, response: bytes, header: Any) -> None:
        """Raises NotOfType."""
        if self._service is None:
            return
        self._answered_at = time.monotonic()
        try:
            self._service.answer(header, response)
        except NotOfType:
            raise
        except Exception as error:  # noqa: BLE001 - the middleware's, as when the caller is gone
            self._loop.call_soon_threadsafe(self.robot.drops.note, "failed", self.topic, first_line(error))
