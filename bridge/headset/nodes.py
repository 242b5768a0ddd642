"""The interface nodes of a headset: topics it receives and publishes, services it calls and runs."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import logging
import time
from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from macs_zenoh.errors import CallTimeout, MacsError, Refused, Unreachable, UsageError
from macs_zenoh.protocol.messages import CallFailure, Metadata, NodeType, decode_data, encode_data
from macs_zenoh.timeouts import within

from . import frames
from .frames import NodeSpec
from .mailbox import Mailbox
from .resumption import StillMeant, always

log = logging.getLogger("macs.headset")

MAX_OPEN_REQUESTS = 64
"""How many requests a served service answers at a time; more are dropped and counted."""
REFUSING_S = 2.5
"""A robot that refuses what is sent says so again every second."""
REQUEST_IDS = 1 << 31
"""Request ids start again after so many: the C# program counts in an int."""


@dataclass(frozen=True)
class Incoming:
    """A message from the router, as a headset receives it: metadata and raw data."""

    metadata: Metadata
    data: bytes

    @property
    def sender_type(self) -> int | None:
        """1 for robots, 2 for headsets, None for the router itself."""
        return self.metadata.sender_agent_type

    @property
    def sender_id(self) -> int | None:
        """The id that the sender wrote; None for the router itself."""
        return self.metadata.sender_agent_id


@dataclass(frozen=True)
class ServiceRequest:
    """A request of a ROS node on robot ``robot`` to a service that runs on this headset."""

    robot: int
    request_id: int
    data: bytes
    takes_failures: bool = False
    """Whether the robot understands a `CallFailure`: raise Refused in the handler to send one."""


ServiceHandler = Callable[[ServiceRequest], "bytes | Awaitable[bytes]"]


class Owner(Protocol):
    """What a node needs of its headset."""

    @property
    def id(self) -> int:
        """The headset's id now."""

    async def send_frame(self, frame: bytes, still_meant: StillMeant | None = None) -> None:
        """Send a frame, and again over the next connection if it was lost with this one, is ``still_meant`` then, and
        the gateway knows us again. Raises Unreachable without a connection."""

    async def tell(self, frame: Callable[[int], bytes]) -> None:
        """Send what a reconnection would repeat anyway: without a connection it waits for that."""

    def time_of_command(self, agents: Collection[int], groups: Collection[int]) -> tuple[int, str]:
        """The time of a command to these robots and groups that is made now, and by which clock; 0 and empty where
        none is told."""

    def forget(self, node: Node) -> None:
        """The node is closed."""


class Refusal(NamedTuple):
    """Why a robot does not take part in a node. ``at_s`` is when it said so, by the monotonic clock.

    ``final``: it refused the node itself, and stays with that until it is asked again; otherwise something that was
    sent, which it says again while more of it comes.
    """

    reason: str
    final: bool
    at_s: float


class Node:
    """An interface node that this headset asked robots for. `agents` and `groups` are where it is registered."""

    def __init__(self, owner: Owner, spec: NodeSpec) -> None:
        self.spec = spec
        self.agents: set[int] = set()
        self.groups: set[int] = set()
        self.refusals: dict[int, Refusal] = {}
        """What robots said last that refused the node, or what was sent for it."""
        self._owner = owner
        self._refused = asyncio.Event()

    async def register(self, *, agents: Collection[int] = (), groups: Collection[int] = ()) -> None:
        """Register at these robots, and at the robots of these groups, where it is not registered yet."""
        new_agents = [agent for agent in agents if agent not in self.agents]
        new_groups = [group for group in groups if group not in self.groups]
        self.agents.update(new_agents)
        for agent in new_agents:
            self.refusals.pop(agent, None)
        self.groups.update(new_groups)
        if new_agents or new_groups:
            await self._owner.tell(lambda own_id: frames.registration(own_id, self.spec, new_agents, new_groups))

    async def deregister(self, *, agents: Collection[int] = (), groups: Collection[int] = ()) -> None:
        """Leave these robots and groups."""
        self.agents.difference_update(agents)
        self.groups.difference_update(groups)
        await self._owner.tell(lambda own_id: frames.deregistration(own_id, self.spec, agents, groups))

    def refused(self, robot: int, reason: str, *, final: bool) -> None:
        """A robot refused the node, or with ``final`` false something that was sent for it."""
        before = self.refusals.get(robot)
        self.refusals[robot] = Refusal(reason, final, time.monotonic())
        if before is None or before.reason != reason:
            part = "send something of" if self.spec.kind == NodeType.SUBSCRIBER else "take what is sent for"
            what = "refused" if final else f"does not {part}"
            log.warning("robot %d %s %s: %s", robot, what, self.spec.tos_name, reason)
        self._refused.set()

    def refusing(self) -> dict[int, str]:
        """The robots that refuse now, and why."""
        now = time.monotonic()
        return {
            robot: refusal.reason
            for robot, refusal in sorted(self.refusals.items())
            if refusal.final or now - refusal.at_s < REFUSING_S
        }

    async def wait_refused(self) -> None:
        """Wait until every robot that was asked for this node has refused it."""
        while not self.refused_everywhere:
            self._refused.clear()
            await self._refused.wait()

    @property
    def refused_everywhere(self) -> bool:
        """Whether every robot that was asked for this node has refused it."""
        final = {robot for robot, refusal in self.refusals.items() if refusal.final}
        return bool(self.agents) and not self.groups and self.agents <= final

    async def close(self) -> None:
        """Leave all robots and groups; the node is gone. Two messages, agents then groups, as the C# program."""
        agents, groups = sorted(self.agents), sorted(self.groups)
        self._owner.forget(self)
        await self.deregister(agents=agents)
        await self.deregister(groups=groups)

    def receive(self, message: Incoming) -> Mailbox[Incoming] | None:
        """Take a message for this node; a mailbox where the reader shall put it, None if that is done."""
        log.warning("a message came for %s, which takes none", self.spec.tos_name)
        return None

    def end(self) -> None:
        """The headset is closed."""


class Subscription(Node):
    """A robot topic. Iterate over it for `Incoming` messages, or give a callback to `Headset.subscribe`.

    Holds the last ``buffer_size`` messages for a slow taker (the first ones with ``drop_new``); `dropped` counts
    the others.
    """

    def __init__(self, owner: Owner, spec: NodeSpec, callback: Callable[[Incoming], object] | None = None) -> None:
        super().__init__(owner, spec)
        self._callback = callback
        self._mailbox: Mailbox[Incoming] = Mailbox(spec.buffer_size, drop_new=spec.drop_new)

    @property
    def dropped(self) -> int:
        """How many messages were dropped here because nobody took them."""
        return self._mailbox.dropped

    def __aiter__(self) -> Subscription:
        return self

    async def __anext__(self) -> Incoming:
        return await self._mailbox.__anext__()

    def receive(self, message: Incoming) -> Mailbox[Incoming] | None:
        if self._callback is None:
            return self._mailbox
        try:
            self._callback(message)
        except Exception:  # a faulty callback costs its message, never the connection
            log.exception("the callback of %s failed", self.spec.tos_name)
        return None

    def end(self) -> None:
        self._mailbox.close()


class Publisher(Node):
    """A robot topic that this headset publishes to."""

    async def publish(self, cdr: bytes, *, agents: Collection[int] = (), groups: Collection[int] = ()) -> None:
        """Send one message to these robots and groups, by default to all where it is registered.

        Raises Unreachable without a connection, TooManyDestinations above 10 agents or groups.
        """
        if not agents and not groups:
            agents, groups = sorted(self.agents), sorted(self.groups)
        if not agents and not groups:
            raise UsageError(f"{self.spec.tos_name} is registered with no robot and no group")
        request_id, clock = self._owner.time_of_command(agents, groups)
        frame = frames.node_data(self._owner.id, self.spec, cdr, agents, groups, request_id=request_id, clock=clock)
        await self._owner.send_frame(frame)


class ServiceClient(Node):
    """A service that runs on robots and that this headset calls.

    With ``failures`` each request names `CallFailure` as its manager, so a robot that knows it tells why a call
    failed; other robots stay silent, and the time runs out.
    """

    def __init__(self, owner: Owner, spec: NodeSpec) -> None:
        super().__init__(owner, spec)
        self._next_request = 0  # 0 is a real request id
        self._open: dict[tuple[int, int], asyncio.Future[bytes]] = {}

    async def call(self, agent: int, request: bytes, timeout_s: float, *, failures: bool = False) -> bytes:
        """Raises Refused when the robot has a reason, CallTimeout, Unreachable when the connection ends first or the
        robot has no such service."""
        request_id = self._next_request
        self._next_request = (request_id + 1) % REQUEST_IDS
        manager = CallFailure.manager if failures else ""
        frame = frames.node_data(self._owner.id, self.spec, request, (agent,), request_id=request_id, manager=manager)
        answer = asyncio.get_running_loop().create_future()
        self._open[agent, request_id] = answer
        try:
            await self._owner.send_frame(frame, lambda: not answer.done())
            return await within(answer, timeout_s)
        except asyncio.TimeoutError as error:
            raise CallTimeout(f"service {self.spec.tos_name} of robot {agent}", timeout_s) from error
        finally:
            del self._open[agent, request_id]

    def refused(self, robot: int, reason: str, *, final: bool) -> None:
        super().refused(robot, reason, final=final)
        fail_all([answer for (agent, _), answer in self._open.items() if agent == robot], Refused(reason))

    def fail(self, error: Unreachable) -> None:
        """The connection that the answers would come over is gone."""
        fail_all(self._open.values(), error)

    def receive(self, message: Incoming) -> None:
        answer = self._open.get((message.sender_id or 0, message.metadata.request_id))
        if answer is None or answer.done():
            log.info("an answer of %s came too late", self.spec.tos_name)
        elif message.metadata.message_manager == CallFailure.manager and message.data[:1] == b"{":
            # a robot that knows no failures may copy the manager of the request; CDR never begins with a brace
            answer.set_exception(self._problem(message))
        else:
            answer.set_result(message.data)

    def _problem(self, message: Incoming) -> MacsError:
        failure = decode_data(CallFailure, message.data)
        if failure.kind in ("absent", "timeout"):
            return Unreachable(f"service {self.spec.tos_name} of robot {message.sender_id}", failure.reason)
        return Refused(failure.reason)


class Service(Node):
    """A service that runs on this headset for ROS nodes on robots."""

    def __init__(self, owner: Owner, spec: NodeSpec, handler: ServiceHandler) -> None:
        super().__init__(owner, spec)
        self.dropped = 0
        self._handler = handler
        self._open: set[asyncio.Task[None]] = set()

    def receive(self, message: Incoming) -> None:
        if len(self._open) >= MAX_OPEN_REQUESTS:
            self.dropped += 1
            log.warning("%s: %d requests open, one more dropped", self.spec.tos_name, len(self._open))
            return
        metadata = message.metadata
        takes_failures = metadata.message_manager == CallFailure.manager
        request = ServiceRequest(message.sender_id or 0, metadata.request_id, message.data, takes_failures)
        task = asyncio.get_running_loop().create_task(self._answer(request))
        self._open.add(task)
        task.add_done_callback(self._open.discard)

    async def _answer(self, request: ServiceRequest) -> None:
        try:
            answer = self._handler(request)
            response = await answer if inspect.isawaitable(answer) else answer
        except Refused as refusal:
            await self._fail(request, refusal.reason)
        except Exception:
            log.exception("the handler of %s failed", self.spec.tos_name)
            await self._fail(request, "internal error")
        else:
            await self._send(request, response)

    async def _fail(self, request: ServiceRequest, reason: str) -> None:
        """Tell why there is no answer; a robot that does not know failures waits for its own deadline."""
        if request.takes_failures:
            await self._send(request, encode_data(CallFailure("failed", reason)), CallFailure.manager)

    async def _send(self, request: ServiceRequest, data: bytes, manager: str = "") -> None:
        frame = frames.node_data(
            self._owner.id, self.spec, data, (request.robot,), request_id=request.request_id, manager=manager
        )
        with contextlib.suppress(Unreachable):
            await self._owner.send_frame(frame, always)

    def end(self) -> None:
        for task in self._open:
            task.cancel()


def fail_all(answers: Collection[asyncio.Future[bytes]], error: MacsError) -> None:
    """Let everybody who waits for an answer fail with this error."""
    for answer in answers:
        if not answer.done():
            answer.set_exception(error)
