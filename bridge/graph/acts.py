"""What is done to robots from a command line: messages published, services called, goals given to actions.

Each of them may move a robot, so nothing here chooses a robot where there are several.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from bridge.headset.actions import ABORTED, CANCELED, SUCCEEDED, ActionClient, Goal
from bridge.headset.frames import NodeSpec
from bridge.headset.nodes import Incoming
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError, Refused, Unreachable
from macs_zenoh.plain import plain
from macs_zenoh.protocol.messages import ROS, ActionVerb, Metadata, NodeType
from macs_zenoh.protocol.offers import absolute, closest, short_type
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import STATUS, Offered
from macs_zenoh.timeouts import within
from macs_zenoh.topics import TopicPublisher
from macs_zenoh.typed import Types, part_of_action, request_of

from .echo import SUMMARY_BYTES, Emit, Say
from .site import Site, named, refusal, type_of, type_of_action
from .words import as_yaml

log = logging.getLogger("macs.graph")

SETTLE_S = 0.5
"""How long is waited between registering and the first message: ROS nodes have to find a publisher that is new."""
CONFIRM_S = 1.0
"""How long a robot may take, after the last message, until it is clear that it refused none of them."""
LAST_MESSAGES_S = 0.2
"""For robots that do not confirm: leaving at once would take the publisher off before ROS has carried the message."""
GOAL_STATUS = {SUCCEEDED: "SUCCEEDED", CANCELED: "CANCELED", ABORTED: "ABORTED"}


# -- publish ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pace:
    """How often is published, and how many times; None: until stopped."""

    rate_hz: float = 1.0
    count: int | None = None
    settle_s: float = SETTLE_S


class Publication:
    """One ``topic pub``: what was sent and who refused it."""

    def __init__(self, site: Site, topic: str, of_type: str | None, value: Mapping[str, Any]) -> None:
        self._site = site
        self._topic = absolute(topic)
        self._type = of_type
        self._value = value
        self.refused: dict[int, str] = {}
        """Robots that do not take what is sent, and why."""
        self._sent = 0

    async def publish(self, pace: Pace, say: Say, emit: Emit, *, as_json: bool) -> int:
        """Publish; the exit code, 1 where a robot refused. Raises Unreachable, UsageError, Refused, CallTimeout and
        what `Types.serialize` raises."""
        robots = self._site.only()
        offers = await (self._site.offers if self._type else self._site.must_offer)(robots)
        of_type = self._type or type_of(self._topic, NodeType.PUBLISHER, offers)
        types = Types()
        cdr = types.serialize(of_type, self._value)
        publisher = await self._site.agent.advertise(
            self._topic,
            robot=self._site.chosen.robots or (robots if not self._site.chosen.groups else ()),
            group=self._site.chosen.groups,
            type=of_type,
            timeout_s=self._site.timeout_s,
        )
        with publisher:
            publisher.on_refused(self._note)
            self.refused.update(publisher.refused)
            self._hint(offers)
            await asyncio.sleep(pace.settle_s)
            shown = types.deserialize(of_type, cdr, max_bytes=SUMMARY_BYTES)
            try:
                await self._repeat(publisher, cdr, pace, lambda number: self._tell(number, shown, say, as_json))
                await self._confirm(robots)
            except asyncio.CancelledError:  # how who publishes until stopped ends
                if pace.count is not None:
                    raise
        return self._conclude(robots, emit, as_json=as_json)

    def _note(self, robot: int, reason: str) -> None:
        for one in self._site.online() if robot == 0 else [robot]:
            if self.refused.get(one) != reason:
                self.refused[one] = reason

    def _hint(self, offers: Mapping[int, Offered]) -> None:
        """A name that nobody subscribes to may be misspelled; nothing is said where none is alike."""
        for robot, offered in offers.items():
            if self._topic not in offered.subscribers and (near := closest(self._topic, offered.subscribers)):
                self.refused[robot] = f"it offers no subscriber to {self._topic}; did you mean {near}?"
            elif self._topic not in offered.subscribers:
                log.warning("nobody on robot %d subscribes to %s now", robot, self._topic)

    async def _repeat(self, publisher: TopicPublisher, cdr: bytes, pace: Pace, tell: Callable[[int], None]) -> None:
        began = time.monotonic()
        while pace.count is None or self._sent < pace.count:
            publisher.publish(cdr)
            self._sent += 1
            tell(self._sent)
            if self._sent != pace.count:
                await asyncio.sleep(began + self._sent / pace.rate_hz - time.monotonic())

    async def _confirm(self, robots: Collection[int]) -> None:
        """Wait until the robots have answered something that was sent now, and so all that was sent before: a refusal
        of that has come before the answer."""
        answered: set[int] = set()
        all_ = asyncio.Event()

        def take(message: Message) -> None:
            answered.add(message.sender_id)
            if answered >= set(robots):
                all_.set()

        with self._site.agent.on_message(take):
            for robot in robots:
                self._site.agent.send(b"", to=ROS, ids=[robot], metadata=Metadata(message_manager=STATUS))
            try:
                await within(all_.wait(), CONFIRM_S)
            except asyncio.TimeoutError:
                await asyncio.sleep(LAST_MESSAGES_S)

    def _tell(self, number: int, shown: Mapping[str, Any], say: Say, as_json: bool) -> None:
        if not as_json:
            say(f"publishing #{number}: {json.dumps(shown)}")

    def _conclude(self, robots: Collection[int], emit: Emit, *, as_json: bool) -> int:
        refused = {robot: why for robot, why in sorted(self.refused.items()) if robot in robots}
        if as_json:
            rows = [{"robot": robot, "reason": why} for robot, why in refused.items()]
            emit({"topic": self._topic, "sent": self._sent, "refused": rows})
        if refused and not as_json:
            raise refusal(refused)
        return 1 if refused else 0


# -- services --------------------------------------------------------------------------------------------------------


async def call_service(
    site: Site, service: str, of_type: str | None, value: Mapping[str, Any], say: Say, emit: Emit, *, as_json: bool
) -> int:
    """Call a service of each robot that is meant, and show the answers. Returns the exit code, 1 where one failed.

    Raises Unreachable, UsageError, and what `Types.serialize` raises.
    """
    service, robots = absolute(service), site.only()
    of_type = of_type or type_of(service, NodeType.CLIENT, await site.must_offer(robots))
    Types().serialize(request_of(of_type), value)  # before any robot does it
    code = 0

    async def ask(robot: int) -> tuple[dict[str, Any], float]:
        began = time.monotonic()
        answer = await site.agent.call_service(service, value, robot=robot, type=of_type, timeout_s=site.timeout_s)
        return answer, (time.monotonic() - began) * 1000

    answers = await asyncio.gather(*map(ask, robots), return_exceptions=True)
    for robot, answer in zip(robots, answers, strict=True):
        line: dict[str, Any] = {"service": service, "robot": robot}
        if isinstance(answer, MacsError):
            code = 1
            if len(robots) == 1 and not as_json:
                raise answer
            line["problem"] = str(answer)
        elif isinstance(answer, BaseException):
            raise answer
        else:
            line |= {"response": answer[0], "ms": round(answer[1], 2)}
        if as_json:
            emit(line)
        else:
            head = f"response of robot {robot}:" if len(robots) > 1 else "response:"
            said = plain(line["problem"]) if "problem" in line else as_yaml(line["response"])
            say(f"{head}\n{said}\n")
    return code


# -- actions ---------------------------------------------------------------------------------------------------------


class MeshAction(ActionClient):
    """An action of robots, given goals by an agent on the mesh. `Agent.use_action` registers it."""

    def __init__(self, agent: Agent, action: str, of_type: str) -> None:
        super().__init__(_Nobody(agent), NodeSpec(NodeType.ACTION, action, short_type(of_type)))
        self._agent = agent
        self._numbers = itertools.count()

    async def tell(self, robot: int, verb: ActionVerb, data: bytes) -> None:
        metadata = Metadata(
            request_id=next(self._numbers) & 0x7FFFFFFF,
            message_manager=verb.value,
            node_type=NodeType.ACTION,
            node_name=self.spec.name,
            data_exchange_type=self.spec.data_type,
        )
        self._agent.send(data, to=ROS, ids=[robot], metadata=metadata)

    async def is_there(self, robot: int) -> bool:
        """Whether a robot is online now."""
        return (ROS, robot) in self._agent.directory

    def take(self, message: Message) -> None:
        """A message to the agent."""
        said = message.metadata
        if (said.node_type, said.node_name) != (NodeType.ACTION, self.spec.name):
            return
        try:
            self.receive(Incoming(said, message.data))
        except MacsError as error:
            log.warning("what robot %d says of %s cannot be used: %s", message.sender_id, self.spec.tos_name, error)


class _Nobody:
    """What a client of a headset's action asks of its headset, where there is none."""

    def __init__(self, agent: Agent) -> None:
        self.id = agent.id

    async def send_frame(self, frame: bytes, still_meant: object = None) -> None:
        raise NotImplementedError

    async def tell(self, frame: Callable[[int], bytes]) -> None:
        raise NotImplementedError

    def time_of_command(self, agents: Collection[int], groups: Collection[int]) -> tuple[int, str]:
        """It commands nothing."""
        return 0, ""

    def forget(self, node: object) -> None:
        """It holds nothing."""


@dataclass(frozen=True)
class GoalWish:
    """A goal for an action, whether its feedback is shown, and after how many seconds it is cancelled, if at all."""

    value: Mapping[str, Any]
    feedback: bool = False
    cancel_after_s: float | None = None


async def send_goal(
    site: Site, action: str, of_type: str | None, wish: GoalWish, say: Say, emit: Emit, *, as_json: bool
) -> int:
    """Give a goal to an action of one robot and wait for its result; the exit code, 1 unless it succeeded.

    Cancelling this cancels the goal. Raises Unreachable, UsageError, Refused, CallTimeout, and what `Types.serialize`
    raises.
    """
    action, robots = absolute(action), site.only()
    if len(robots) > 1:
        raise Unreachable(f"one robot for {action}", f"{named(robots)} are meant, and a goal is for one")
    of_type = short_type(of_type or type_of_action(action, await site.must_offer(robots)))
    types = Types()
    cdr = types.serialize(part_of_action(of_type, "Goal"), wish.value)
    client = MeshAction(site.agent, action, of_type)
    line: dict[str, Any] = {"action": action, "robot": robots[0]}
    used = await site.agent.use_action(action, robot=robots[0], type=of_type, timeout_s=site.timeout_s)
    with used, site.agent.on_message(client.take):
        if not as_json:
            say(f"Sending goal:\n{_indented(as_yaml(dict(wish.value)))}")
        goal = await client.send_goal(robots[0], cdr, timeout_s=site.timeout_s)
        if as_json:
            emit({**line, "goal": goal.id.hex()})
        else:
            say(f"\nGoal accepted with ID: {goal.id.hex()}")

        async def steps() -> None:
            async for feedback in goal:
                if wish.feedback:
                    value = types.deserialize(part_of_action(of_type, "Feedback"), feedback, max_bytes=SUMMARY_BYTES)
                    if as_json:
                        emit({**line, "feedback": value})
                    else:
                        say(f"\nFeedback:\n{_indented(as_yaml(value))}")

        following = asyncio.create_task(goal.follow(client.is_there))
        try:
            status, result = await _result(goal, steps, wish.cancel_after_s)
        finally:
            following.cancel()
    value = types.deserialize(part_of_action(of_type, "Result"), result, max_bytes=SUMMARY_BYTES)
    ended = GOAL_STATUS.get(status, str(status))
    if as_json:
        emit({**line, "status": ended.lower(), "result": value})
    else:
        say(f"\nResult:\n{_indented(as_yaml(value))}\n\nGoal finished with status: {ended}")
    return 0 if status == SUCCEEDED else 1


async def _result(goal: Goal, steps: Callable[[], Any], cancel_after_s: float | None) -> tuple[int, bytes]:
    try:
        await within(steps(), cancel_after_s)
    except asyncio.TimeoutError:
        await goal.cancel()
    except asyncio.CancelledError:
        with contextlib.suppress(MacsError):  # nobody looks after it any more
            await asyncio.shield(goal.cancel(timeout_s=CONFIRM_S))
        raise
    try:
        return await goal.result(timeout_s=5.0)
    except Refused as refused:  # forgotten, or its server is gone
        raise Refused(f"the goal has no result: {refused.reason}") from refused


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.split("\n"))
