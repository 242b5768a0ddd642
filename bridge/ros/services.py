"""Interface nodes for services of the robot, which headsets call (type 3). Those of headsets are in `served`.

A call has a deadline, and many can be open at once: nothing waits in the ROS thread. How a call that fails is told is
written in docs/robot.md.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from msgspec import structs

from bridge.ros.failures import CallFailed, answer_metadata, tell_failure
from bridge.ros.interface import InterfaceNode, Registrant, Robot
from bridge.ros.servers import ABSENT_S, Search, check_service_type
from bridge.ros.side import Client, NotOfType, ServiceType, first_line
from bridge.ros.unity_cdr import TooManyParts, readable, to_unity
from macs_zenoh.protocol.messages import AddNode, NodeType
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import NodeStatus
from macs_zenoh.timeouts import within

log = logging.getLogger("macs.ros")

BURST = 8
"""ROS keeps 10 requests of a service, and 10 responses of a client, that were not taken yet, and loses the oldest of
more without a word (rmw_qos_profile_services_default). So not more than these go out at once."""
PACE_S = 0.05
"""With so many requests unanswered, one more goes out so often: the service may well work on many at a time."""


class ClientNode(InterfaceNode):
    """Type 3: headsets call a service that runs on the robot. The answer goes to who asked, registered or not."""

    NODE_TYPE = NodeType.CLIENT
    ROLE = "service client"
    INTERFACE = "srv"

    MATCH_S = 0.5
    """How long a new client waits to find a service that exists."""

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        self._client: Client | None = None
        self._service: ServiceType | None = None
        self._exists = False
        self._deadline_s = robot.rules.call_timeout_s(self.topic)
        self._calls: dict[asyncio.Task[None], Message] = {}
        self._search = Search(lambda: self._client is not None and self._client.is_ready())
        self._room = asyncio.Semaphore(BURST)

    def open(self) -> None:
        side = self.robot.session
        self._service = side.service(self.interface, self.topic)
        self._exists = check_service_type(side, self.topic, self.interface)
        self._client = side.client(self._service, self.request.tos_name)

    def other_types(self) -> set[str]:
        if self._client is None or self._client.is_ready():
            return set()
        known = dict(self.robot.session.services()).get(self.topic, [])
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
            client.close()

    def receive(self, message: Message) -> None:
        if self.held:
            self._fail(message, self._stopped())
            return
        if len(self._calls) >= self.robot.rules.settings.max_calls:
            self._fail(message, CallFailed("refused", f"{len(self._calls)} calls of {self.topic} are open"))
            return
        call = asyncio.get_running_loop().create_task(self._call(message, self.robot.stop.times))
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

    def status(self) -> NodeStatus:
        return structs.replace(super().status(), open_calls=len(self._calls))

    async def _call(self, message: Message, stops: int) -> None:
        try:
            response = await within(self._ask(message.data, stops), self._deadline_s)
        except CallFailed as error:
            self._fail(message, error)
        except asyncio.TimeoutError:
            self._fail(message, CallFailed("timeout", f"{self.topic} did not answer within {self._deadline_s:g} s"))
        except Exception as error:
            log.exception("%s: a call failed", self.topic)
            self._fail(message, CallFailed("failed", first_line(error)))
        else:
            asker = Registrant.of(message)
            if asker in self.unity:
                response = to_unity(self._service.response.unity if self._service else None, response)
            if (size := len(response)) > (limit := self.robot.rules.settings.max_frame_bytes):
                self._fail(message, CallFailed("failed", f"the response has {size} bytes, more than {limit}"))
                return
            self.robot.send(asker, answer_metadata(self.robot.agent_id, message.metadata), response)

    async def _ask(self, data: bytes, stops: int) -> bytes:
        assert self._service is not None
        asked = self._service.request
        try:
            request = readable(asked.unity, asked.parts, data, self.robot.rules.settings.max_message_parts)
        except TooManyParts as error:
            raise CallFailed("invalid", f"the request of {len(data)} bytes is too much: {error}") from None
        problem = asked.problem(request)
        if problem is not None:
            raise CallFailed("invalid", f"the request is no {self.interface}: {problem}")
        if not await self._search.found(min(ABSENT_S, self._deadline_s / 2)):
            raise CallFailed("absent", f"there is no service {self.topic} on this robot")
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[bytes] = loop.create_future()

        def settle(response: bytes | None, problem: str) -> None:
            if answer.done():
                return
            if response is None:
                answer.set_exception(CallFailed("failed", problem))
            else:
                answer.set_result(response)

        await self._room.acquire()
        release = _Once(self._room.release)
        pace = loop.call_later(PACE_S, release)
        try:

            def done(response: bytes | None, problem: str) -> None:
                loop.call_soon_threadsafe(settle, response, problem)

            forget = await self.robot.session.run(lambda: self._send(request, stops, done))
            try:
                return await answer
            finally:
                if self._client is not None:
                    forget()
        finally:
            pace.cancel()
            release()

    def _stopped(self) -> CallFailed:
        return CallFailed("refused", self.stop_reason())

    def _fail(self, message: Message, error: CallFailed) -> None:
        about = f"{self.topic} from {message.sender_type}/{message.sender_id}"
        self.robot.drops.note(f"call_{error.failure.kind}", about, error.failure.reason)
        tell_failure(self.robot, message, error.failure.kind, error.failure.reason)

    # -- in the ROS thread ---------------------------------------------------------------------------------------

    def _send(self, request: bytes, stops: int, done: Callable[[bytes | None, str], None]) -> Callable[[], None]:
        if self._client is None:
            raise CallFailed("refused", f"{self.topic} is no longer registered")
        if self.held_since(stops):  # pressed while the call waited for the service, or for its turn
            raise self._stopped()
        try:
            return self._client.call(request, done)
        except NotOfType as error:
            raise CallFailed("invalid", f"the request is no {self.interface}: {error}") from error


class _Once:
    """Calls an action the first time it is called itself."""

    def __init__(self, action: Callable[[], None]) -> None:
        self._action: Callable[[], None] | None = action

    def __call__(self) -> None:
        action, self._action = self._action, None
        if action is not None:
            action()
