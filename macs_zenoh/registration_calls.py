"""What is asked of robots for agents: interface nodes added and removed, by calls that are answered.

A gateway asks for its headsets, an agent for itself.

Each call is for one robot and node; a newer one for the same node replaces it. A robot that does not answer is asked
again while it is online; a refusal is final until the agent asks again or the robot comes back. Of the calls to one
robot only so many are open at one time, and agents take turns: one that asks for much makes no other wait.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial

from msgspec import structs

from .calls_together import CallsTogether, Question, Told, in_order
from .errors import HeldByAnother, OutOfRange, Refused, Unreachable
from .mesh import Mesh, Traffic
from .protocol.agent_id import AgentId
from .protocol.directory import Change, Directory
from .protocol.limits import NODE_AGENTS
from .protocol.messages import (
    ROS,
    AddNode,
    Metadata,
    NodeRefused,
    NodeType,
    RemoveNode,
    node_name,
)
from .protocol.registrations import AgentKey, Registrations, Robots, StreamKey, Task, removal
from .protocol.routing import call_of
from .protocol.together import MOST
from .protocol.turns import Turns
from .protocol.wire import Layout

log = logging.getLogger("macs.registrations")

CALL_TIMEOUT_S = 2.0
RETRY_S = (0.05, 0.05, 0.1, 0.2, 0.5)
"""Pauses between attempts, the last one repeated: a robot that has just come is online a moment before it serves."""
ATTEMPTS = 120
MOVE_S = 1.0
"""How long an agent's change to another id waits for a robot."""

OPEN_CALLS = 256
"""Calls to one robot that may be open at one time."""
OPEN_CALLS_EACH = 16
"""Those of one agent among them."""
CALLS_EACH = 8192
"""Calls of one agent, to all robots, that may be wanted at one time."""

TURN_S = 0.003
"""After so long of making calls everything else has its turn."""

CallKey = tuple[int, int, str]
"""(robot id, node type, node name)."""

StreamChanges = list[tuple[StreamKey, set[AgentKey] | None]]
"""Topics of robots that somebody here is registered on since before, and who; None: nobody any more."""


class _Call:
    """One call, and how far it is."""

    __slots__ = ("again", "asked", "attempt", "over", "task", "told")

    def __init__(self, task: Task, told: Told, attempt: int) -> None:
        self.task = task
        self.told = told
        self.attempt = attempt
        self.asked = False
        """Whether the robot was asked, and has not answered yet."""
        self.over = False
        """Whether it is not wanted any more."""
        self.again: asyncio.TimerHandle | None = None


class RobotCalls:
    """Registrations of agents, and the calls that make them true on the robots."""

    def __init__(
        self,
        mesh: Mesh,
        directory: Directory,
        layout: Layout,
        *,
        on_streams: Callable[[StreamChanges], None],
        on_refused: Callable[[AgentKey, NodeRefused], None],
        on_done: Callable[[Task], None] = lambda task: None,
        together: bool = False,
    ) -> None:
        """``on_done`` hears of each task that a robot has confirmed; ``together``: their blocks are ours, so robots
        may be asked for several agents in one query."""
        self._mesh = mesh
        self._layout = layout
        self._on_streams = on_streams
        self._on_refused = on_refused
        self._on_done = on_done
        self._registrations = Registrations()
        self._online: Robots = {agent.id: agent.group for agent in directory.of_type(ROS)}
        self._calls: dict[AgentKey, dict[CallKey, _Call]] = {}
        self._turns: dict[int, Turns[CallKey, _Call]] = {}
        self._ready: dict[Turns[CallKey, _Call], int] = {}
        """Those of which calls may be made, with their robots."""
        self._goes_on = False
        """Whether they are made behind all that is wanted, or answered, in this round of the loop."""
        self._together = CallsTogether(mesh, CALL_TIMEOUT_S) if together else None
        self._to_start: deque[Iterator[Task]] = deque()
        """Tasks whose calls are not wanted yet, since there are many."""
        self._told: Told | None = None
        """The last one."""
        self._closed = False

    def close(self) -> None:
        """End all calls."""
        self._closed = True
        for calls in self._calls.values():
            for wanted in calls.values():
                wanted.over = True
                if wanted.again is not None:
                    wanted.again.cancel()
        self._calls.clear()
        self._turns.clear()
        self._ready.clear()
        self._to_start.clear()

    def register(self, node: AddNode | RemoveNode, robot_ids: list[int], groups: list[int]) -> None:
        """An agent registers on, or leaves, a node of these robots."""
        if isinstance(node, AddNode) and node.node_name != node_name(node.tos_name):  # it would get another's commands
            self.refuse(node, next(iter(robot_ids), 0), f"{node.node_name[:80]!r} is not its node name")
            return
        if isinstance(node, AddNode):
            if len(robot_ids) > NODE_AGENTS:
                self.refuse(node, 0, f"a registration names at most {NODE_AGENTS} robots; use groups for more")
                return
            tasks = self._registrations.add(node, robot_ids, groups, self._online)
        else:
            tasks = self._registrations.remove(node, robot_ids, groups, self._online)
        self._streams_changed()
        for task in tasks:
            self._start(task)

    def leave(self, agent: AgentKey) -> None:
        """An agent is gone. Robots drop it when its presence ends; here it is only forgotten, except for what is on
        its way: that could reach a robot after the news that the headset has left."""
        self._registrations.leave(agent)
        self._streams_changed()
        for wanted in self._forget_calls(agent):
            if wanted.asked and isinstance(wanted.task.node, AddNode):
                self._start(Task(wanted.task.robot_id, removal(wanted.task.node)))

    def find(self, agent: AgentKey, node_type: int, node_name: str) -> AddNode | None:
        """What an agent registered on a node."""
        return self._registrations.find(agent, node_type, node_name)

    def registered(self, agent: AgentKey, metadata: Metadata, robot_id: int) -> bool:
        """Whether an agent registered a message's node on this robot."""
        return self._registrations.registered(agent, metadata.node_type, metadata.node_name, robot_id)

    def named(self, agent: AgentKey) -> int:
        """How many robots and groups an agent's registrations name."""
        return self._registrations.named(agent)

    def naming(self, node: AddNode, robot_ids: list[int], groups: list[int]) -> int:
        """How many more that would be with this one."""
        return self._registrations.naming(node, robot_ids, groups)

    def take_back_all(self, agent: AgentKey, node_type: int, node_name: str) -> None:
        """An agent has a node of another type under this name now: take its registrations of the former back."""
        where = self._registrations.where(agent, node_type, node_name)
        self.register(RemoveNode(*agent, node_type, node_name), *where)

    def presence(self, change: Change) -> None:
        """A robot that comes, comes back or changes its group is told everything that is registered for it, and what
        it has to take back of a group that it has left. Where an agent has left, another may have its place."""
        agent, online, same = change
        if same:
            return
        if agent.type != ROS:
            if not online:
                self._start_all(self._registrations.holder_left(agent.key, self._online))
            return
        if self._together is not None:
            self._together.forget(agent.id)
        if not online:
            self._online.pop(agent.id, None)
            return
        was_online = agent.id in self._online
        self._online[agent.id] = agent.group
        left = self._registrations.seen(agent.id, agent.group)
        self._streams_changed()
        self._start_all([*(left if was_online else ()), *self._registrations.of_robot(agent.id, agent.group)])

    def to_prepare(self, agent: AgentKey, agent_id: int) -> list[Task]:
        """What makes robots know an agent under the id that it is about to have, too. Services, which take one agent
        only, are left to `rename`."""
        tasks = self._registrations.of_agent(agent, self._online)
        nodes = [(task.robot_id, task.node) for task in tasks if task.node.node_type != NodeType.SERVICE]
        return [Task(r, structs.replace(node, registrant_agent_id=agent_id)) for r, node in nodes]

    async def prepare(self, tasks: list[Task], slow: set[int]) -> list[Task]:
        """Tell it; what robots have confirmed. Those in ``slow`` are not waited for; those that do not answer in time
        get into it."""
        return await self._try(tasks, slow)

    def take_back(self, tasks: list[Task]) -> None:
        """The agent left before it had the other id. No presence ends under that id, so robots have to be told."""
        for task in tasks:
            self._start(Task(task.robot_id, removal(task.node)))

    async def rename(self, agent: AgentKey, agent_id: int, told: list[Task], slow: set[int]) -> None:
        """An agent has another id now; robots forget the one before. ``told`` is what `prepare` gave."""
        before = self._registrations.of_agent(agent, self._online)
        self._registrations.rename(agent, agent_id)
        self._streams_changed()
        for task in self._registrations.of_agent((agent[0], agent_id), self._online):
            self._listen(task)  # it is registered under the new id
        self._forget_calls(agent)
        forget = [Task(task.robot_id, removal(task.node)) for task in before]
        forgotten = await self._try(forget, slow)
        for task in [*forget, *self._registrations.of_agent((agent[0], agent_id), self._online)]:
            if task not in told and task not in forgotten:
                self._start(task)

    async def _try(self, tasks: list[Task], slow: set[int]) -> list[Task]:
        """Tell robots something at once, for not longer than ``MOVE_S``; what they have confirmed."""
        told = []

        async def ask(task: Task) -> None:
            with suppress(Refused, Unreachable, OutOfRange):
                await self._ask(task)
                told.append(task)

        asked = {asyncio.ensure_future(ask(task)): task for task in tasks if task.robot_id not in slow}
        if asked:
            _, late = await asyncio.wait(asked, timeout=MOVE_S)
            for asking in late:
                slow.add(asked[asking].robot_id)
                asking.cancel()
        return told

    def repeat(self, agent: AgentKey) -> None:
        """Tell robots again everything that one agent registered."""
        self._start_all(self._registrations.of_agent(agent, self._online))

    def repeat_all(self) -> None:
        """Our own link was lost: robots may have seen our agents leave, so tell them everything again."""
        for robot_id, group in self._online.items():
            self._start_all(self._registrations.of_robot(robot_id, group))

    def refuse(self, node: AddNode | RemoveNode, robot_id: int, reason: str) -> None:
        """Tell an agent that it does not get a node of a robot, 0 being all of them."""
        if isinstance(node, AddNode):
            refused = NodeRefused(
                robot_id=robot_id,
                node_type=node.node_type,
                node_name=node.node_name,
                tos_name=node.tos_name,
                reason=reason,
            )
            self._on_refused((node.registrant_agent_type, node.registrant_agent_id), refused)

    def _streams_changed(self) -> None:
        gone: StreamChanges = [(key, None) for key in self._registrations.gone()]
        if gone:
            self._on_streams(gone)

    def _listen(self, task: Task) -> None:
        """A robot is about to be asked for a topic: whoever receives it must do so before."""
        if isinstance(task.node, AddNode) and task.node.node_type == NodeType.SUBSCRIBER:
            key = (task.robot_id, task.node.node_name)
            registrants = self._registrations.wanted(key)
            if registrants is not None:
                self._on_streams([(key, registrants)])

    # -- calls ---------------------------------------------------------------------------------------------------

    def _start_all(self, tasks: Iterable[Task]) -> None:
        """Many may be for one robot: what there is no time for now is wanted in other rounds of the loop."""
        self._to_start.append(iter(tasks))
        if len(self._to_start) == 1:
            self._start_some()

    def _start_some(self) -> None:
        until = time.monotonic() + TURN_S
        while self._to_start:
            for task in self._to_start[0]:
                try:
                    if self._is_due(task):
                        self._start(task)
                except Exception:  # as in `_answered`
                    log.exception("%s failed", _What(task))
                if time.monotonic() > until:
                    asyncio.get_running_loop().call_soon(self._start_some)
                    return
            self._to_start.popleft()

    def _is_due(self, task: Task) -> bool:
        """Whether a task that may have waited is still wanted, as it is."""
        node, holds = task.node, self._registrations.holds(task, self._online)
        if not isinstance(node, AddNode):
            return task.robot_id in self._online and not holds
        return holds and self._registrations.find(_keys(task)[0], node.node_type, node.node_name) is node

    def _start(self, task: Task, attempt: int = 0) -> None:
        agent, key = _keys(task)
        calls = self._calls.setdefault(agent, {})
        if (before := calls.pop(key, None)) is not None:
            self._end(before)
        if len(calls) >= CALLS_EACH:
            self.refuse(task.node, task.robot_id, f"{CALLS_EACH} registrations wait already; try again")
            return
        wanted = calls[key] = _Call(task, self._telling(task.node), attempt)
        turns = self._turns.get(task.robot_id)
        if turns is None:
            turns = self._turns[task.robot_id] = Turns(OPEN_CALLS_EACH, OPEN_CALLS)
        turns.put(agent, key, wanted)
        self._next(task.robot_id, turns)

    def _next(self, robot_id: int, turns: Turns[CallKey, _Call]) -> None:
        if self._closed:
            return
        self._ready[turns] = robot_id
        if not self._goes_on:  # the first at once, and what else is wanted now together
            self._make_calls()
            self._go_on()

    def _go_on(self) -> None:
        if not self._goes_on and not self._closed:
            self._goes_on = True
            asyncio.get_running_loop().call_soon(self._make_calls)

    def _make_calls(self) -> None:
        """As many as there is time for now, and the others in other rounds of the loop."""
        until = time.monotonic() + TURN_S
        self._goes_on = False
        while self._ready:
            turns, robot_id = next(iter(self._ready.items()))
            if questions := self._take(turns, until):
                self._run(questions, turns)
            else:
                del self._ready[turns]
                if not turns.open and self._turns.get(robot_id) is turns:
                    del self._turns[robot_id]
            if self._ready and time.monotonic() > until:
                self._go_on()
                return

    def _take(self, turns: Turns[CallKey, _Call], until: float) -> list[Question[_Call]]:
        """The next calls of a robot: some, or as many as there is time for."""
        questions: list[Question[_Call]] = []
        most = MOST if self._together is not None else 1
        while len(questions) < most and (turn := turns.take()) is not None:
            wanted = turn[2]
            wanted.asked = True
            try:
                self._listen(wanted.task)
                key, frame = self._question(wanted.task, wanted.told)
                alone = self._together is None or wanted.attempt > 0
                questions.append(
                    Question(wanted, turn[0], wanted.task.robot_id, _verb(wanted.task.node), key, frame, alone)
                )
            except Exception as error:  # noqa: BLE001 - it is judged with those that come later
                asyncio.get_running_loop().call_soon(self._answered, wanted, turns, error)
            if time.monotonic() > until:
                break
        return questions

    def _turn_over(self, robot_id: int, turns: Turns[CallKey, _Call], agent: AgentKey) -> None:
        """Others may be asked, when all answers that came together are handled."""
        turns.done(agent)
        self._ready[turns] = robot_id
        self._go_on()

    def _end(self, wanted: _Call) -> None:
        """A call is not wanted any more: its answer, should there be one, says nothing."""
        agent, key = _keys(wanted.task)
        robot_id = wanted.task.robot_id
        wanted.over = True
        if wanted.again is not None:
            wanted.again.cancel()
        if (turns := self._turns.get(robot_id)) is not None:
            turns.drop(agent, key)
            if wanted.asked:  # another's turn, when whoever ends this one is done
                asyncio.get_running_loop().call_soon(self._turn_over, robot_id, turns, agent)

    def _forget_calls(self, agent: AgentKey) -> list[_Call]:
        """No call of this agent is wanted any more. Returns them."""
        calls = list(self._calls.pop(agent, {}).values())
        for wanted in calls:
            self._end(wanted)
        return calls

    def _is_over(self, wanted: _Call) -> None:
        agent, key = _keys(wanted.task)
        calls = self._calls.get(agent, {})
        if calls.get(key) is wanted:
            del calls[key]
        if not calls:
            self._calls.pop(agent, None)

    def _run(self, questions: list[Question[_Call]], turns: Turns[CallKey, _Call]) -> None:
        for some in in_order(questions):
            if self._together is not None and len(some) > 1 and self._together.takes(some[0]):
                self._together.ask(some, lambda each, answer: self._answered(each.of, turns, answer))
                continue
            for each in some:
                answered = partial(self._answered, each.of, turns)
                try:
                    of, traffic = each.robot_id, Traffic.REGISTRATION
                    self._mesh.ask(each.key, each.frame, answered, of=of, timeout_s=CALL_TIMEOUT_S, traffic=traffic)
                except Exception as error:  # noqa: BLE001 - it is judged with those that come later
                    asyncio.get_running_loop().call_soon(answered, error)

    def _answered(self, wanted: _Call, turns: Turns[CallKey, _Call], answer: bytes | Exception) -> None:
        if wanted.over or self._closed:
            return
        wanted.asked = False
        try:
            self._judge(wanted, answer)
        except Exception:  # whatever an agent asked for, it must not be wanted for ever
            log.exception("%s failed", _What(wanted.task))
            self._is_over(wanted)
        self._turn_over(wanted.task.robot_id, turns, _keys(wanted.task)[0])

    def _judge(self, wanted: _Call, answer: bytes | Exception) -> None:
        """What a call has come to."""
        task = wanted.task
        if isinstance(answer, Unreachable):
            log.debug("%s: %s", _What(task), answer)
            pause_s = RETRY_S[min(wanted.attempt, len(RETRY_S) - 1)]
            wanted.again = asyncio.get_running_loop().call_later(pause_s, self._again, wanted)
            return
        if isinstance(answer, (Refused, OutOfRange)):  # by the robot, or here by a traffic rule
            log.warning("%s was refused: %s", _What(task), answer)
            if isinstance(answer, HeldByAnother):
                self._registrations.refused(task, answer.holder)
            self.refuse(task.node, task.robot_id, str(answer))
        elif isinstance(answer, Exception):
            raise answer
        else:
            log.debug("%s: done", _What(task))
            self._on_done(task)
        self._is_over(wanted)

    def _again(self, wanted: _Call) -> None:
        """Make a call once more, unless it was taken back; a robot that is away is told everything when it returns."""
        task = wanted.task
        self._is_over(wanted)
        if isinstance(task.node, AddNode):
            holds = self._registrations.holds(task, self._online)
        else:
            holds = task.robot_id in self._online
        if not holds:
            return
        if wanted.attempt + 1 < ATTEMPTS:
            self._start(task, wanted.attempt + 1)
        else:
            log.warning("%s: the robot does not answer", _What(task))

    async def _ask(self, task: Task) -> None:
        self._listen(task)
        question = self._question(task, self._telling(task.node))
        await self._mesh.query(*question, timeout_s=CALL_TIMEOUT_S, traffic=Traffic.REGISTRATION)

    def _telling(self, node: AddNode | RemoveNode) -> Told:
        if self._told is None or self._told.node is not node:
            self._told = Told(node)
        return self._told

    def _question(self, task: Task, told: Told) -> tuple[str, bytes]:
        """Key and frame of a call."""
        node = task.node
        sender = (node.registrant_agent_type, node.registrant_agent_id)
        return call_of((ROS, task.robot_id), _verb(node), sender, told.message, self._layout)


def _keys(task: Task) -> tuple[AgentKey, CallKey]:
    node = task.node
    return (node.registrant_agent_type, node.registrant_agent_id), (task.robot_id, node.node_type, node.node_name)


def _verb(node: AddNode | RemoveNode) -> str:
    return "add_node" if isinstance(node, AddNode) else "remove_node"


class _What:
    """A call in words, for the log: made only where they are read."""

    def __init__(self, task: Task) -> None:
        self._task = task

    def __str__(self) -> str:
        robot_id, node = self._task
        who = AgentId(node.registrant_agent_type, node.registrant_agent_id)
        return f"{who}: {_describe(node)} on ros/{robot_id}"


def _describe(node: AddNode | RemoveNode) -> str:
    kind = NodeType(node.node_type).name.lower() if node.node_type in list(NodeType) else f"node type {node.node_type}"
    verb = "add" if isinstance(node, AddNode) else "remove"
    return f"{verb} {kind} {getattr(node, 'tos_name', '') or node.node_name}"
