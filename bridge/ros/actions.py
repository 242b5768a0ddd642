"""Interface node of type 5: a headset gives goals to an action that runs on the robot (docs/actions.md).

A goal outlives the connection of its headset: its result is kept for a while, and goes to whoever asks for it with
the goal's id, which only the headset that chose it knows, and those of its group that it lets see it.
"""

from __future__ import annotations

import asyncio
import logging
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
from msgspec import structs

from bridge.ros.graph import SEND_GOAL
from bridge.ros.interface import InterfaceNode, Registrant, Robot
from bridge.ros.servers import ABSENT_S, Search
from bridge.ros.side import ActionType, Goals, GoalTold, Side, first_line
from bridge.ros.stream import cdr_problem
from bridge.ros.unity_cdr import TooManyParts, readable
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.messages import ROS, ActionVerb, AddNode, NodeType
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import GoalStatus, NodeStatus

log = logging.getLogger("macs.ros")

ID_BYTES = 16
UNKNOWN, ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = range(7)
"""action_msgs/GoalStatus."""
WATCH_S = 1.0
GONE_S = 5.0
"""An action server that cannot be seen for so long has taken its goals with it."""
CANCEL_AGAIN_S = 1.0
CANCEL_TIMES = 5
"""A cancellation without an answer is asked for again after so long, so many times in all. ROS loses the answer of a
server that has found our client's goals but not yet its cancellations; to ask twice does no harm."""
TERMINATED = 3
"""action_msgs/CancelGoal: the goal cannot be canceled any more, because it is being canceled or has ended."""


@dataclass
class Goal:
    """One goal: who gets its feedback and result, and what became of it."""

    id: bytes
    owner: Registrant | None
    """None: it has left, and nobody is told until somebody asks with the goal's id."""
    group: int
    request_id: int
    node_name: str
    """Under which its owner registered the action."""
    stops: int = 0
    """How often the robot had been stopped when it was given."""
    status: int = UNKNOWN
    """As in action_msgs/GoalStatus."""
    result: bytes = b""
    """CDR, or the reason in UTF-8 when there is no result."""
    finished_at: float | None = None
    cancel_wanted: bool = False
    accepted: bool = False
    former: Registrant | None = None
    """Who had it when it left. It goes on hearing of the goal if it comes back before another has its id."""


class ActionNode(InterfaceNode):
    """Type 5: goals of headsets to one action, their feedback, results and cancellation."""

    NODE_TYPE = NodeType.ACTION
    ROLE = "action client"
    INTERFACE = "action"

    MATCH_S = 0.5

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        self._client: Goals | None = None
        self._types: ActionType | None = None
        self._goals: dict[bytes, Goal] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._watching: asyncio.TimerHandle | None = None
        self._search = Search(lambda: self._client is not None and self._client.is_ready())
        self._seen_at = 0.0
        self._accept_s = robot.rules.call_timeout_s(self.topic)
        self._loop = asyncio.get_running_loop()

    @property
    def in_use(self) -> bool:
        return bool(self.registrants) or bool(self._goals)

    @classmethod
    def resolve(cls, side: Side, name: str) -> str:
        """ROS remaps each of an action's services by itself; goals go where this one leads."""
        resolved = side.service_name(name + SEND_GOAL)
        if not resolved.endswith(SEND_GOAL):
            raise Refused(f"{name[:80]}: its goals are remapped to {resolved}, which is no action")
        return resolved.removesuffix(SEND_GOAL)

    def known_names(self) -> list[str]:
        services = self.robot.session.services()
        return [name.removesuffix(SEND_GOAL) for name, _ in services if name.endswith(SEND_GOAL)]

    def open(self) -> None:
        side = self.robot.session
        goals = dict(side.services()).get(self.topic + SEND_GOAL, [])
        self.interface.check(self.topic, {of_type.removesuffix("_SendGoal") for of_type in goals})
        self._types = side.action(self.interface, self.topic)
        self._client = side.goals(self._types, self.request.tos_name)

    async def settle(self) -> None:
        await self._found(self.MATCH_S)

    def retire(self) -> None:
        self.cut_off()  # nobody could cancel them any more
        for task in self._tasks:
            task.cancel()
        if self._watching is not None:
            self._watching.cancel()

    def close(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def left(self, agent: Registrant) -> None:
        for goal in list(self._goals.values()):
            if goal.owner == agent:
                goal.owner, goal.former = None, agent
                if self.rule.cancel_on_leave:
                    self._cancel(goal)
            elif goal.former == agent:  # its id is another one's now
                goal.former = None

    def fell_asleep(self, agent: Registrant) -> None:
        """Its goals end as when it leaves, and it hears how when it is back."""
        if self.rule.cancel_on_leave:
            for goal in list(self._goals.values()):
                if goal.owner == agent:
                    self._cancel(goal)

    def returned(self, agent: Registrant) -> None:
        for goal in self._goals.values():
            if goal.owner is None and goal.former == agent:
                goal.owner, goal.former = agent, None

    def emergency_stop(self, by: str) -> None:
        if not self.rule.allow_while_stopped:  # whatever holds by the time the loop comes to it
            self._loop.call_soon_threadsafe(self._cancel_all)

    def cut_off(self) -> None:
        """Nobody is seen to leave, so all have left."""
        if self.rule.cancel_on_leave:
            self._cancel_all()

    def _cancel_all(self) -> None:
        for goal in self._goals.values():
            self._cancel(goal)

    def status(self) -> NodeStatus:
        return structs.replace(super().status(), goals=[_shown(goal) for goal in self._goals.values()])

    # -- what headsets say ---------------------------------------------------------------------------------------

    def receive(self, message: Message) -> None:
        verb, goal_id = message.metadata.message_manager, message.data[:ID_BYTES]
        if verb == ActionVerb.LIST:
            self._list(message)
        elif len(goal_id) < ID_BYTES:
            self.robot.drops.note("bad_request", self.topic, f"{verb[:40]!r} without the 16 bytes of a goal id")
        elif verb == ActionVerb.GOAL:
            self._give(message, goal_id)
        elif verb in (ActionVerb.RESULT, ActionVerb.CANCEL):
            goal = self._goals.get(goal_id)
            if goal is None:
                asked = self._asked(message, goal_id)
                self._tell(asked, ActionVerb(verb), UNKNOWN, b"there is no such goal, or its result was not kept")
            elif verb == ActionVerb.CANCEL:
                self._cancel(goal)
            else:
                self._ask_result(goal, message)
        else:
            self.robot.drops.note("bad_request", self.topic, f"{verb[:40]!r} is nothing that an action knows")

    def _give(self, message: Message, goal_id: bytes) -> None:
        sender = Registrant.of(message)
        goal = self._goals.get(goal_id)
        if goal is not None:  # asked again, for want of an answer
            if goal.owner is None:
                self._adopt(goal, message)
            self._tell(goal, ActionVerb.ACCEPTED, int(goal.accepted))
            return
        goal = self._asked(message, goal_id)
        goal.group = self.robot.group_of(sender)
        body = message.data[ID_BYTES:]
        of = self._types.goal if self._types is not None else None
        try:
            if of is not None:
                body = readable(of.unity, of.parts, body, self.robot.rules.settings.max_message_parts)
        except TooManyParts as error:
            self._reject(goal, f"the goal of {len(body)} bytes is too much: {error}")
            return
        problem = of.problem(body) if of is not None else cdr_problem(body)
        if problem is not None:
            self._reject(goal, f"the goal is no {self.interface}: {problem}")
        elif self.held:
            self._reject(goal, self.stop_reason())
        elif not self._room():
            self._reject(goal, f"{len(self._goals)} goals of {self.topic} are open")
        else:
            self._goals[goal_id] = goal
            goal.stops = self.robot.stop.times
            self._spawn(goal, body)

    def _ask_result(self, goal: Goal, message: Message) -> None:
        """Whoever asks gets the result, now or later, and the feedback from now on."""
        self._adopt(goal, message)
        if goal.finished_at is not None:
            self._tell(goal, ActionVerb.RESULT, goal.status, goal.result)

    def _list(self, message: Message) -> None:
        sender = Registrant.of(message)
        group = self.robot.group_of(sender)
        goals = [
            _shown(goal) for goal in self._goals.values() if goal.owner == sender or (group and goal.group == group)
        ]
        asked = self._asked(message, bytes(ID_BYTES))
        self._tell(asked, ActionVerb.LIST, 0, msgspec.json.encode(goals))

    def _adopt(self, goal: Goal, message: Message) -> None:
        """From now on who sent this is told of the goal."""
        goal.owner, goal.request_id = Registrant.of(message), message.metadata.request_id
        goal.node_name, goal.former = message.metadata.node_name, None

    def _asked(self, message: Message, goal_id: bytes) -> Goal:
        """A goal as far as a message tells it, to answer."""
        metadata = message.metadata
        return Goal(goal_id, Registrant.of(message), 0, metadata.request_id, metadata.node_name)

    def refused(self, message: Message, reason: str) -> None:
        if message.metadata.message_manager == ActionVerb.GOAL and len(message.data) >= ID_BYTES:
            self._reject(self._asked(message, message.data[:ID_BYTES]), reason)

    def _room(self) -> bool:
        limit = self.robot.rules.settings.max_calls
        finished = [goal for goal in self._goals.values() if goal.finished_at is not None]
        if len(self._goals) >= limit and finished:
            self._goals.pop(finished[0].id)
        return len(self._goals) < limit

    # -- the life of a goal, on the loop -------------------------------------------------------------------------

    def _spawn(self, goal: Goal, body: bytes) -> None:
        task = self._loop.create_task(self._send(goal, body))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _send(self, goal: Goal, body: bytes) -> None:
        if not await self._found(min(ABSENT_S, self._accept_s / 2)):
            self._drop(goal, f"there is no action {self.topic} on this robot")
            return
        try:
            await self.robot.session.run(lambda: self._send_goal(goal, body))
        except Exception as error:  # noqa: BLE001 - the middleware's, whatever it is
            self._drop(goal, f"the goal is no {self.interface}: {first_line(error)}")
            return
        self._watch()
        await asyncio.sleep(self._accept_s)
        if not goal.accepted and goal.finished_at is None and goal.id in self._goals:
            self._drop(goal, f"{self.topic} did not accept the goal within {self._accept_s:g} s")

    async def _found(self, within_s: float) -> bool:
        self._seen_at = self._loop.time()
        return await self._search.found(within_s)

    def _accepted(self, goal: Goal, accepted: bool) -> None:
        if goal.id not in self._goals:
            if accepted:  # it came too late
                self.robot.session.hurry(lambda: self._send_cancel(goal))
            return
        if not accepted:
            self._drop(goal, f"{self.topic} rejected the goal")
            return
        goal.accepted, goal.status = True, ACCEPTED
        self._tell(goal, ActionVerb.ACCEPTED, 1)
        if goal.cancel_wanted:
            self._cancel(goal)

    def _fed_back(self, goal: Goal, feedback: bytes) -> None:
        if goal.finished_at is None:
            goal.status = EXECUTING
            self._tell(goal, ActionVerb.FEEDBACK, goal.status, feedback)

    def _finished(self, goal: Goal, status: int, result: bytes) -> None:
        if goal.finished_at is not None:
            return
        goal.status, goal.result, goal.finished_at, goal.accepted = status, result, time.monotonic(), False
        self._tell(goal, ActionVerb.RESULT, status, result)
        self._watch()

    def _failed(self, goal: Goal, reason: str) -> None:
        self._finished(goal, ABORTED, reason.encode())

    def _cancel(self, goal: Goal) -> None:
        if goal.finished_at is not None:
            self._tell(goal, ActionVerb.CANCEL, 0, b"the goal has finished")
        elif not goal.accepted:
            goal.cancel_wanted = True
        else:
            self.robot.session.hurry(lambda: self._send_cancel(goal))

    def _reject(self, goal: Goal, reason: str) -> None:
        self._tell(goal, ActionVerb.ACCEPTED, 0, reason.encode())

    def _drop(self, goal: Goal, reason: str) -> None:
        self._goals.pop(goal.id, None)
        self._reject(goal, reason)
        self._check_use()

    def _tell(self, goal: Goal, verb: ActionVerb, code: int, rest: bytes = b"") -> None:
        if goal.owner is None:
            return
        metadata = structs.replace(self.metadata(verb.value, goal.request_id), node_name=goal.node_name)
        self.robot.send(goal.owner, metadata, goal.id + struct.pack("B", code) + rest)

    def _watch(self) -> None:
        """Look now and then for results that are too old, and for a server that died with its goals."""
        if self._watching is None and self._goals:
            self._watching = self._loop.call_later(WATCH_S, self._look)

    def _look(self) -> None:
        self._watching = None
        if self._client is None:
            return
        kept_s = self.robot.rules.settings.result_timeout_s
        now = self._loop.time()
        if self._client.is_ready():
            self._seen_at = now
        gone = now - self._seen_at > GONE_S
        for goal in list(self._goals.values()):
            if goal.finished_at is not None:
                if time.monotonic() - goal.finished_at > kept_s:
                    del self._goals[goal.id]
            elif gone:
                self._finished(goal, ABORTED, b"the action server is gone")
        self._check_use()
        self._watch()

    def _check_use(self) -> None:
        if not self.in_use:
            self.unused()

    # -- in the ROS thread, or `_send_cancel` wherever it is soonest ----------------------------------------------

    def _send_goal(self, goal: Goal, body: bytes) -> None:
        if self._client is None:
            return
        if self.held_since(goal.stops):  # pressed while the goal waited for the action
            self._loop.call_soon_threadsafe(self._drop, goal, self.stop_reason())
            return

        def told(callback: Callable[..., None]) -> Callable[..., None]:
            def tell(*what: object) -> None:
                self._loop.call_soon_threadsafe(callback, goal, *what)

            return tell

        self._client.send(
            goal.id,
            body,
            GoalTold(told(self._accepted), told(self._fed_back), told(self._finished), told(self._failed)),
        )

    def _send_cancel(self, goal: Goal, times: int = 1) -> None:
        if self._client is None or goal.finished_at is not None:
            self._loop.call_soon_threadsafe(self._tell, goal, ActionVerb.CANCEL, 0, b"the goal has finished")
            return

        answered = False

        def cancelling(code: int | None, cancels: bool, problem: str) -> None:
            nonlocal answered
            answered = True
            # it may be the question before this one that it took, whose answer was lost
            done = cancels or (times > 1 and code == TERMINATED)
            reason = b"" if done else problem.encode() or b"the action does not cancel it"
            self._loop.call_soon_threadsafe(self._tell, goal, ActionVerb.CANCEL, int(done), reason)

        def look() -> None:
            if not answered and goal.finished_at is None and times < CANCEL_TIMES:
                self._send_cancel(goal, times + 1)

        self._client.cancel(goal.id, cancelling)
        self.robot.session.later(CANCEL_AGAIN_S, look)


def tell_no_goal(robot: Robot, message: Message, reason: str) -> None:
    """A goal came for which there is no node: tell its sender that it is not accepted."""
    metadata, goal_id = message.metadata, message.data[:ID_BYTES]
    if metadata.node_type != NodeType.ACTION or metadata.message_manager != ActionVerb.GOAL or len(goal_id) < ID_BYTES:
        return
    answer = metadata.sent_by(ROS, robot.agent_id)
    answer = msgspec.structs.replace(answer, message_manager=ActionVerb.ACCEPTED.value)
    robot.send(Registrant.of(message), answer, goal_id + b"\0" + reason.encode())


def _shown(goal: Goal) -> GoalStatus:
    owner = str(goal.owner or goal.former or "")
    return GoalStatus(goal.id.hex(), goal.status, owner, finished=goal.finished_at is not None)
