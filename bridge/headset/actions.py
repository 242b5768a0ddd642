"""Actions that run on robots, given goals by a headset: an extension that the C# program does not have.

::

    turn = await headset.action("/turn", "demo_msgs/Turn", agents=[1])
    goal = await turn.send_goal(1, goal_cdr)
    async for feedback in goal:
        ...
    status, result_cdr = await goal.result()

The bytes are in docs/actions.md.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple

import msgspec

from macs_zenoh.errors import BadJson, CallTimeout, MacsError, Refused, Unreachable, WireError
from macs_zenoh.protocol.messages import ActionVerb
from macs_zenoh.timeouts import within

from . import frames
from .frames import NodeSpec
from .mailbox import Mailbox
from .nodes import REQUEST_IDS, Incoming, Node, Owner

ID_BYTES = 16
UNKNOWN, ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = range(7)
"""action_msgs/GoalStatus."""
ASK_S = 5.0
"""After so long without it a goal's result is asked for."""
LOST_S = 5.0
"""A robot that is away for so long has left; a router that starts again takes less."""
LOOK_S = 1.0
FINISHED = "the goal has finished"


class Result(NamedTuple):
    """How a goal ended. ``data`` is the result's CDR."""

    status: int
    data: bytes


class Goal:
    """A goal given to one robot. Iterate over it for feedback (CDR), which ends with the result."""

    def __init__(self, client: ActionClient, robot: int, goal_id: bytes) -> None:
        loop = asyncio.get_running_loop()
        self.id = goal_id
        self.robot = robot
        self.accepted: asyncio.Future[None] = loop.create_future()
        self.finished: asyncio.Future[Result] = loop.create_future()
        self.cancelling: asyncio.Future[None] = loop.create_future()
        for future in (self.accepted, self.finished, self.cancelling):
            future.add_done_callback(lambda done: done.cancelled() or done.exception())  # nobody has to look
        self._client = client
        self._feedback: Mailbox[bytes] = Mailbox(client.spec.buffer_size)

    def __aiter__(self) -> Mailbox[bytes]:
        return self._feedback

    async def result(self, timeout_s: float | None = None) -> Result:
        """Wait for the end. Raises CallTimeout, Refused when the robot does not know the goal (any more)."""
        result: Result = await _within(self.finished, f"result of {self._client.spec.tos_name}", timeout_s)
        return result

    async def cancel(self, timeout_s: float = 5.0) -> None:
        """Ask the action to stop. Raises Refused when it does not, CallTimeout, Unreachable."""
        if self.finished.done():
            raise Refused(FINISHED)
        await self._client.tell(self.robot, ActionVerb.CANCEL, self.id)
        await _within(self.cancelling, f"cancellation of {self._client.spec.tos_name}", timeout_s)

    async def follow(self, is_there: Callable[[int], Awaitable[bool]]) -> None:
        """Until it has ended: ask for the result now and then, as it may have been lost; end it when the robot, of
        which ``is_there`` knows, stays away: who waits gets Unreachable."""
        loop = asyncio.get_running_loop()
        asked = seen = loop.time()
        while not self.finished.done():
            await asyncio.sleep(LOOK_S)
            with contextlib.suppress(MacsError):  # our own link is lost, and may be made again
                there, now = await is_there(self.robot), loop.time()
                if there and now - asked > ASK_S:
                    await self._client.tell(self.robot, ActionVerb.RESULT, self.id)
                    asked = now
                if not there and now - seen > LOST_S:
                    reason = "it has left, and what becomes of the goal is not known"
                    self._end(Unreachable(f"robot {self.robot}", reason))
                seen = now if there else seen

    def receive(self, verb: str, code: int, rest: bytes) -> None:
        """Something about this goal came from the robot."""
        if verb == ActionVerb.FEEDBACK:
            self._feedback.put(rest)
        elif verb == ActionVerb.ACCEPTED:
            _settle(self.accepted, None if code else Refused(_text(rest)))
            if not code:
                self._end(Refused(_text(rest)))
        elif verb == ActionVerb.CANCEL:
            _settle(self.cancelling, None if code else Refused(_text(rest)))
        elif verb == ActionVerb.RESULT:
            if code == UNKNOWN:
                self._end(Refused(_text(rest)))
            elif not self.finished.done():
                self.finished.set_result(Result(code, rest))
                self._feedback.close()
                # the answer to a cancellation may be behind the result, and finds no goal then
                _settle(self.cancelling, None if code == CANCELED else Refused(FINISHED))

    def _end(self, error: Exception) -> None:
        if not self.finished.done():
            self.finished.set_exception(error)
        self._feedback.close()


class ActionClient(Node):
    """An action of robots that this headset gives goals to. Made by `Headset.action`."""

    def __init__(self, owner: Owner, spec: NodeSpec) -> None:
        super().__init__(owner, spec)
        self._goals: dict[bytes, Goal] = {}
        self._lists: dict[int, asyncio.Future[bytes]] = {}
        self._next_request = 0

    async def send_goal(self, robot: int, goal: bytes, *, timeout_s: float = 5.0) -> Goal:
        """Give a goal (CDR) and wait until it is accepted. Raises Refused, CallTimeout, Unreachable."""
        given = self._open(robot, os.urandom(ID_BYTES))
        try:
            await self.tell(robot, ActionVerb.GOAL, given.id + goal)
            await _within(given.accepted, f"acceptance by {self.spec.tos_name}", timeout_s)
        except BaseException:
            self._goals.pop(given.id, None)
            raise
        return given

    async def resume(self, robot: int, goal_id: bytes) -> Goal:
        """Have the result, and the feedback from now on, of a goal that was given before, perhaps by another headset
        of the same group (see `goals`)."""
        goal = self._open(robot, goal_id)
        _settle(goal.accepted, None)
        await self.tell(robot, ActionVerb.RESULT, goal_id)
        return goal

    async def goals(self, robot: int, *, timeout_s: float = 5.0) -> list[dict[str, Any]]:
        """The goals that the robot knows of this headset and its group: goal (hex), status, owner, finished.

        Raises Unreachable, CallTimeout, BadJson.
        """
        request_id = self._next_request
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._lists[request_id] = answer
        try:
            await self.tell(robot, ActionVerb.LIST, b"")
            told = await _within(answer, self.spec.tos_name, timeout_s)
            return msgspec.json.decode(told, type=list[dict[str, Any]])
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise BadJson("a list of goals", str(error)) from error
        finally:
            del self._lists[request_id]

    async def tell(self, robot: int, verb: ActionVerb, data: bytes) -> None:
        """Send one message of this action. Raises Unreachable."""
        request_id = self._next_request
        self._next_request = (request_id + 1) % REQUEST_IDS
        # not again when it is lost: a goal would set the robot going when nobody expects it any more
        await self._owner.send_frame(
            frames.node_data(self._owner.id, self.spec, data, (robot,), request_id=request_id, manager=verb.value)
        )

    async def ask_again(self) -> None:
        """After a reconnection: ask for everything that may have come meanwhile."""
        for goal in list(self._goals.values()):
            if not goal.finished.done():
                with contextlib.suppress(Unreachable):
                    await self.tell(goal.robot, ActionVerb.RESULT, goal.id)

    def receive(self, message: Incoming) -> None:
        verb = message.metadata.message_manager
        goal_id, rest = message.data[:ID_BYTES], message.data[ID_BYTES + 1 :]
        if len(message.data) <= ID_BYTES:
            raise WireError(f"{verb[:40]!r} of {self.spec.tos_name} is too short")
        if verb == ActionVerb.LIST:
            answer = self._lists.get(message.metadata.request_id)
            if answer is not None and not answer.done():
                answer.set_result(rest)
            return
        goal = self._goals.get(goal_id)
        if goal is None:
            return
        goal.receive(verb, message.data[ID_BYTES], rest)
        if goal.finished.done():
            del self._goals[goal_id]

    def end(self) -> None:
        for goal in self._goals.values():
            goal._end(Unreachable(f"robot {goal.robot}", "the headset is closed"))
        self._goals.clear()

    def _open(self, robot: int, goal_id: bytes) -> Goal:
        goal = self._goals[goal_id] = Goal(self, robot, goal_id)
        return goal


async def _within(future: asyncio.Future[Any], what: str, timeout_s: float | None) -> Any:
    try:
        return await within(asyncio.shield(future), timeout_s)
    except asyncio.TimeoutError as error:
        raise CallTimeout(what, timeout_s or 0.0) from error


def _settle(future: asyncio.Future[None], error: Exception | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(None)
    else:
        future.set_exception(error)


def _text(reason: bytes) -> str:
    return reason.decode(errors="replace") or "no reason given"
