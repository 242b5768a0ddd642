"""Interface nodes for services: a headset calls a service of the robot (type 3), a ROS node one of a headset (type 4).

Both have deadlines, and many calls can be open at once: nothing waits in the ROS thread. How a call that fails is told
is written in docs/robot.md.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy.node import NodeNameNonExistentError
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message

from bridge.ros import fields
from bridge.ros.interface import InterfaceNode, Registrant, Robot, ros_errors
from bridge.ros.stream import cdr_problem
from bridge.ros.types import InterfaceName, resolve
from bridge.ros.unity_cdr import UnityCdr, to_ros, to_unity
from macs_zenoh.errors import Refused, WireError
from macs_zenoh.protocol.messages import ROS, AddNode, CallFailure, Metadata, NodeType, decode_data, encode_data
from macs_zenoh.protocol.reading import Message
from macs_zenoh.timeouts import within

log = logging.getLogger("macs.ros")

ABSENT_S = 2.0
"""How long a call waits for a service that is not there: one that has just started is found within this, also on a
busy machine. At most half of the call's own time."""
LOOK_S = 0.02
"""Pause between looks for it; ROS tells nobody when a service appears."""
KNOWN_S = 0.15
"""How long a service that we have found may need to find us."""
BURST = 8
"""ROS keeps 10 requests of a service, and 10 responses of a client, that were not taken yet, and loses the oldest of
more without a word (rmw_qos_profile_services_default). So not more than these go out at once."""
PACE_S = 0.05
"""With so many requests unanswered, one more goes out so often: the service may well work on many at a time."""
PACE_FAILURES_S = 0.005
DEPTH = QoSProfile(depth=1000)
"""Of our own ends, so that on them nothing is lost."""
REQUEST_IDS = 1 << 31
"""The C# program counts in an int."""


class CallFailed(Exception):
    """A call has no response; ``kind`` as in `CallFailure`."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.failure = CallFailure(kind, reason)


def answer_metadata(agent_id: int, request: Metadata, *, failed: bool = False) -> Metadata:
    """Of an answer to a request of an interface node: the same node and request id."""
    return Metadata(
        sender_agent_type=ROS,
        sender_agent_id=agent_id,
        request_id=request.request_id,
        message_manager=CallFailure.manager if failed else "",
        node_type=request.node_type,
        node_name=request.node_name,
        data_exchange_type=request.data_exchange_type,
    )


def tell_failure(robot: Robot, message: Message, kind: str, reason: str) -> None:
    """Tell the caller why there is no answer, if it is one that asked for that. Existing programs time out."""
    if message.metadata.message_manager == CallFailure.manager:
        metadata = answer_metadata(robot.agent_id, message.metadata, failed=True)
        robot.send(Registrant.of(message), metadata, encode_data(CallFailure(kind, reason)))
    elif message.metadata.node_type == NodeType.PUBLISHER:
        robot.tell_refused(message, "", kind, reason)


class Search:
    """Looks for a server: ``ready`` tells whether its side of everything is known here."""

    def __init__(self, ready: Callable[[], bool]) -> None:
        self._ready = ready
        self._known_at: float | None = None

    async def found(self, within_s: float) -> bool:
        """Whether it is there, and knows us: it finds out later than we do, and its answers would be lost."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + within_s
        while not self._ready():
            self._known_at = None
            if loop.time() > deadline:
                return False
            await asyncio.sleep(LOOK_S)
        if self._known_at is None:
            self._known_at = loop.time() + KNOWN_S
        if (wait_s := self._known_at - loop.time()) > 0:
            await asyncio.sleep(wait_s)
        return True


class ClientNode(InterfaceNode):
    """Type 3: headsets call a service that runs on the robot. The answer goes to who asked, registered or not."""

    NODE_TYPE = NodeType.CLIENT
    ROLE = "service client"
    INTERFACE = "srv"

    MATCH_S = 0.5
    """How long a new client waits to find a service that exists."""

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        self._client: Any = None
        self._service: Any = None
        self._request_cdr: UnityCdr | None = None
        self._response_cdr: UnityCdr | None = None
        self._exists = False
        self._deadline_s = robot.rules.call_timeout_s(self.topic)
        self._calls: dict[asyncio.Task[None], Message] = {}
        self._search = Search(lambda: self._client is not None and self._client.service_is_ready())
        self._room = asyncio.Semaphore(BURST)

    def open(self) -> None:
        self._service = resolve(str(self.interface), "srv")
        self._request_cdr = UnityCdr.of(self._service.Request)
        self._response_cdr = UnityCdr.of(self._service.Response)
        node = self.robot.session.node
        self._exists = check_service_type(node, self.topic, self.interface)
        with ros_errors(self.request.tos_name):
            self._client = node.create_client(self._service, self.request.tos_name, qos_profile=DEPTH)

    def other_types(self) -> set[str]:
        if self._client is None or self._client.service_is_ready():
            return set()
        known = dict(self.robot.session.node.get_service_names_and_types()).get(self.topic, [])
        return set(known) - {str(self.interface)}

    async def settle(self) -> None:
        if self._exists:
            await self._search.found(self.MATCH_S)

    def retire(self) -> None:
        for call, message in self._calls.items():
            call.cancel()
            self._fail(message, CallFailed("refused", f"{self.topic} is no longer registered"))

    def close(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self.robot.session.node.destroy_client(client)

    def receive(self, message: Message) -> None:
        if self.held:
            self._fail(message, self._stopped())
            return
        if len(self._calls) >= self.robot.rules.settings.max_calls:
            self._fail(message, CallFailed("refused", f"{len(self._calls)} calls of {self.topic} are open"))
            return
        call = asyncio.get_running_loop().create_task(self._call(message))
        self._calls[call] = message
        call.add_done_callback(self._calls.pop)

    def left(self, agent: Registrant) -> None:
        """Its id may be another one's when the answer comes."""
        for call, message in list(self._calls.items()):
            if Registrant.of(message) == agent:
                call.cancel()
                self.robot.drops.note("late_answer", self.topic, f"{agent} left before its call was answered")

    def refused(self, message: Message, reason: str) -> None:
        self._fail(message, CallFailed("refused", reason))

    def status(self) -> dict[str, Any]:
        return {**super().status(), "open_calls": len(self._calls)}

    async def _call(self, message: Message) -> None:
        try:
            response = await within(self._ask(message.data), self._deadline_s)
        except CallFailed as error:
            self._fail(message, error)
        except asyncio.TimeoutError:
            self._fail(message, CallFailed("timeout", f"{self.topic} did not answer within {self._deadline_s:g} s"))
        else:
            asker = Registrant.of(message)
            if asker in self.unity:
                response = to_unity(self._response_cdr, response)
            if (size := len(response)) > (limit := self.robot.rules.settings.max_frame_bytes):
                self._fail(message, CallFailed("failed", f"the response has {size} bytes, more than {limit}"))
                return
            self.robot.send(asker, answer_metadata(self.robot.agent_id, message.metadata), response)

    async def _ask(self, data: bytes) -> bytes:
        request = to_ros(self._request_cdr, data)
        problem = cdr_problem(request)
        if problem is not None:
            raise CallFailed("invalid", f"the request is no {self.interface}: {problem}")
        if not await self._search.found(min(ABSENT_S, self._deadline_s / 2)):
            raise CallFailed("absent", f"there is no service {self.topic} on this robot")
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[bytes] = loop.create_future()

        def settle(response: bytes | None, error: CallFailed | None) -> None:
            if answer.done():
                return
            if error is not None:
                answer.set_exception(error)
            elif response is not None:
                answer.set_result(response)

        await self._room.acquire()
        release = _Once(self._room.release)
        pace = loop.call_later(PACE_S, release)
        try:
            sent = await self.robot.session.run(lambda: self._send(request, loop, settle))
            try:
                return await answer
            finally:
                if self._client is not None:
                    self._client.remove_pending_request(sent)
        finally:
            pace.cancel()
            release()

    def _stopped(self) -> CallFailed:
        return CallFailed("refused", f"the emergency stop by {self.robot.stop.by} holds")

    def _fail(self, message: Message, error: CallFailed) -> None:
        about = f"{self.topic} from {message.sender_type}/{message.sender_id}"
        self.robot.drops.note(f"call_{error.failure.kind}", about, error.failure.reason)
        tell_failure(self.robot, message, error.failure.kind, error.failure.reason)

    # -- in the ROS thread ---------------------------------------------------------------------------------------

    def _send(
        self,
        request: bytes,
        loop: asyncio.AbstractEventLoop,
        settle: Callable[[bytes | None, CallFailed | None], None],
    ) -> Any:
        if self._client is None:
            raise CallFailed("refused", f"{self.topic} is no longer registered")
        if self.held:  # pressed while the call waited for the service, or for its turn
            raise self._stopped()
        try:
            sent = self._client.call_async(deserialize_message(request, self._service.Request))
        except RuntimeError as error:
            raise CallFailed("invalid", f"the request is no {self.interface}: {first_line(error)}") from error

        def answered(future: Any) -> None:
            try:
                response = bytes(serialize_message(future.result()))
            except Exception as error:  # noqa: BLE001 - rclpy's, whatever it is
                loop.call_soon_threadsafe(settle, None, CallFailed("failed", first_line(error)))
            else:
                loop.call_soon_threadsafe(settle, response, None)

        sent.add_done_callback(answered)
        return sent


class _Once:
    """Calls an action the first time it is called itself."""

    def __init__(self, action: Callable[[], None]) -> None:
        self._action: Callable[[], None] | None = action

    def __call__(self) -> None:
        action, self._action = self._action, None
        if action is not None:
            action()


class OpenCall(NamedTuple):
    """A ROS node's call that a headset has not answered yet."""

    header: Any
    timer: asyncio.TimerHandle


class ServiceNode(InterfaceNode):
    """Type 4: a service that a headset runs, for ROS nodes on the robot. One registrant.

    rclpy sends as the response what the callback returned, through ``send_response`` of the service object, with the
    header of the request. So the callback returns the request, and a ``send_response`` of our own takes both and
    leaves; the response is sent when there is one. rclpy's own way of answering later, a coroutine, makes the executor
    spin as long as any call is open.

    ROS has no word for a call that failed. The caller gets a response with every field zero (see `fields.failure`)
    at the deadline, when the headset says that it failed, and when the headset leaves.
    """

    NODE_TYPE = NodeType.SERVICE
    ROLE = "service"
    INTERFACE = "srv"
    MAX_REGISTRANTS = 1

    TURN = 64
    """Requests taken in one turn of the executor."""
    LINGER_S = 0.25
    """How long a service stays after its last response: destroyed at once, it takes unread responses with it."""

    WATCH_S = 1.0
    """Pause between looks for another server."""

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        self._service: Any = None
        self._types: Any = None
        self._request_cdr: UnityCdr | None = None
        self._response_cdr: UnityCdr | None = None
        self._respond: Callable[[Any, Any], None]
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
        self._types = resolve(str(self.interface), "srv")
        self._request_cdr = UnityCdr.of(self._types.Request)
        self._response_cdr = UnityCdr.of(self._types.Response)
        fields.failure(self._types.Response, "", self.rule.error_response, "error_response")
        node = self.robot.session.node
        check_service_type(node, self.topic, self.interface)
        if others := servers_elsewhere(node, self.topic):
            raise Refused(f"{self.topic} is served by {' and '.join(others)} on this robot")
        with ros_errors(self.request.tos_name):
            self._service = node.create_service(
                self._types, self.request.tos_name, lambda request, response: request, qos_profile=DEPTH
            )
        self._respond = self._service.send_response
        self._service.send_response = self._take

    async def settle(self) -> None:
        self._watch()

    def _watch(self) -> None:
        """ROS tells nobody when a service appears. A node of the robot that begins to serve this one wins: a call goes
        to both, and the headset's answer may be the first."""
        self._watching = self._loop.call_later(self.WATCH_S, self.robot.session.submit, self._look_for_others)

    def _look_for_others(self) -> None:
        """In the ROS thread."""
        node = self.robot.session.node
        if self._service is None or self._closing:
            return
        others = servers_elsewhere(node, self.topic) if node.count_services(self.topic) > 1 else []
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
            self.robot.session.node.destroy_service(service)

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
        answer = to_ros(self._response_cdr, message.data)
        problem = cdr_problem(answer)
        if problem is not None:
            self._bad_answer(request_id, sender, problem)
            return
        self._close_call(request_id)
        self.robot.session.submit(lambda: self._send(request_id, sender, call.header, answer))

    def status(self) -> dict[str, Any]:
        return {**super().status(), "open_calls": len(self._open_calls)}

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
            request = to_unity(self._request_cdr, request)
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

    def _take(self, request: Any, header: Any) -> None:
        self._pass_on(request, header)
        handle = self._service.handle
        with handle:
            for _ in range(self.TURN):
                request, header = handle.service_take_request(self._types.Request)
                if header is None:
                    return
                self._pass_on(request, header)

    def _pass_on(self, request: Any, header: Any) -> None:
        self._loop.call_soon_threadsafe(self._ask, bytes(serialize_message(request)), header)

    def _send(self, request_id: int, sender: Registrant, header: Any, answer: bytes) -> None:
        try:
            response = deserialize_message(answer, self._types.Response)
        except RuntimeError as error:
            problem = first_line(error)
            about = f"{self.topic} from {sender}"
            self._loop.call_soon_threadsafe(
                self.robot.drops.note, "bad_cdr", about, f"its answer is no {self.interface}: {problem}"
            )
            self._send_failure(header, f"the answer of {sender} is no {self.interface}: {problem}")
            return
        self._answer(response, header)

    def _send_failure(self, header: Any, reason: str) -> None:
        self._failed.append((header, reason))
        if len(self._failed) == 1:
            self._send_failures()

    def _send_failures(self) -> None:
        """A few at a time: many calls fail at once when a headset leaves."""
        for header, reason in list(self._failed)[:BURST]:
            values = self.rule.error_response
            self._answer(fields.failure(self._types.Response, reason, values, "error_response"), header)
        for _ in range(min(BURST, len(self._failed))):
            self._failed.popleft()
        if self._failed:
            self.robot.session.later(PACE_FAILURES_S, self._send_failures)
        elif self._closing:
            self._end_when_read()

    def _answer(self, response: Any, header: Any) -> None:
        if self._service is None:
            return
        self._answered_at = time.monotonic()
        try:
            self._respond(response, header)
        except RuntimeError as error:  # the caller is gone
            self._loop.call_soon_threadsafe(self.robot.drops.note, "failed", self.topic, first_line(error))


def check_service_type(node: Any, service: str, interface: InterfaceName) -> bool:
    """Whether the service exists. Raises Refused when it has another type. In the ROS thread."""
    types = dict(node.get_service_names_and_types()).get(service, [])
    interface.check(service, types)
    return bool(types) and node.count_services(service) > 0


def servers_elsewhere(node: Any, service: str) -> list[str]:
    """Full names of the other ROS nodes that have this service. In the ROS thread.

    What has our own name is not among them: after a crash of ours ROS knows our old service for a while.
    """
    found = set()
    for name, namespace in node.get_node_names_and_namespaces():
        full = f"{namespace.rstrip('/')}/{name}"
        if full != node.get_fully_qualified_name():
            try:
                services = node.get_service_names_and_types_by_node(name, namespace)
            except NodeNameNonExistentError:  # it has left meanwhile
                continue
            if any(served == service for served, _ in services):
                found.add(full)
    return sorted(found)


def first_line(error: Exception) -> str:
    """What an error says, without the places in C++ that it came through."""
    text = str(error).splitlines()
    return text[0].split(", at ")[0] if text else type(error).__name__
