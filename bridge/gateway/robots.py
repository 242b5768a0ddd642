"""What a gateway asks of robots for its headsets: interface nodes added and removed, by calls that are answered.

Each call is one task per robot and node; a newer one for the same node replaces it. A robot that does not answer is
asked again while it is online; a refusal is final until the headset asks again or the robot comes back.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress

from msgspec import structs

from macs_zenoh.directory import Change, Directory
from macs_zenoh.errors import OutOfRange, Refused, Unreachable
from macs_zenoh.mesh import Mesh
from macs_zenoh.messages import ROS, AddNode, Metadata, NodeRefused, NodeType, RemoveNode, encode_data, node_name
from macs_zenoh.registrations import AgentKey, Registrations, Robots, Streams, Task
from macs_zenoh.routing import call
from macs_zenoh.wire import Layout

log = logging.getLogger("macs.gateway")

CALL_TIMEOUT_S = 2.0
RETRY_S = (0.05, 0.05, 0.1, 0.2, 0.5)
"""Pauses between attempts, the last one repeated: a robot that has just come is online a moment before it serves."""
ATTEMPTS = 120
MOVE_S = 1.0
"""How long an agent's change to another id waits for a robot."""

TaskKey = tuple[int, AgentKey, int, str]


class RobotCalls:
    """Registrations of this gateway's headsets, and the calls that make them true on the robots."""

    def __init__(
        self,
        mesh: Mesh,
        directory: Directory,
        layout: Layout,
        *,
        on_streams: Callable[[Streams], None],
        on_refused: Callable[[AgentKey, NodeRefused], None],
    ) -> None:
        self._mesh = mesh
        self._directory = directory
        self._layout = layout
        self._on_streams = on_streams
        self._on_refused = on_refused
        self._registrations = Registrations()
        self._running: dict[TaskKey, asyncio.Task[None]] = {}
        self._seen: Robots = {}

    def close(self) -> None:
        """End all calls."""
        for running in self._running.values():
            running.cancel()

    def register(self, node: AddNode | RemoveNode, robot_ids: list[int], groups: list[int]) -> None:
        """A headset registers on, or leaves, a node of these robots."""
        robots = self._robots()
        if isinstance(node, AddNode) and node.node_name != node_name(node.tos_name):  # it would get another's commands
            self._refused(Task(next(iter(robot_ids), 0), node), f"{node.node_name[:80]!r} is not its node name")
            return
        if isinstance(node, AddNode):
            tasks = self._registrations.add(node, robot_ids, groups, robots)
        else:
            tasks = self._registrations.remove(node, robot_ids, groups, robots)
        self._streams_changed()
        for task in tasks:
            self._start(task)

    def leave(self, agent: AgentKey) -> None:
        """A headset is gone. Robots drop it when its presence ends; here it is only forgotten."""
        self._registrations.leave(agent)
        self._streams_changed()

    def find(self, agent: AgentKey, node_type: int, node_name: str) -> AddNode | None:
        """What an agent registered on a node."""
        return self._registrations.find(agent, node_type, node_name)

    def presence(self, change: Change) -> None:
        """A robot that comes, comes back or changes its group is told everything that is registered for it."""
        agent, online = change
        if agent.type != ROS:
            return
        if online:
            for task in self._registrations.of_robot(agent.id, agent.group):
                self._start(task)
        self._streams_changed()

    def to_prepare(self, agent: AgentKey, agent_id: int) -> list[Task]:
        """What makes robots know an agent under the id that it is about to have, too. Services, which take one agent
        only, are left to `rename`."""
        tasks = self._registrations.of_agent(agent, self._robots())
        nodes = [(task.robot_id, task.node) for task in tasks if task.node.node_type != NodeType.SERVICE]
        return [Task(r, structs.replace(node, registrant_agent_id=agent_id)) for r, node in nodes]

    async def prepare(self, tasks: list[Task], slow: set[int]) -> list[Task]:
        """Tell it; what robots have confirmed. Those in ``slow`` are not waited for; those that do not answer in time
        get into it."""
        return await self._try(tasks, slow)

    def take_back(self, tasks: list[Task]) -> None:
        """The agent left before it had the other id. No presence ends under that id, so robots have to be told."""
        for task in tasks:
            self._start(Task(task.robot_id, _removal(task.node)))

    async def rename(self, agent: AgentKey, agent_id: int, told: list[Task], slow: set[int]) -> None:
        """An agent has another id now; robots forget the one before. ``told`` is what `prepare` gave."""
        before = self._registrations.of_agent(agent, self._robots())
        self._registrations.rename(agent, agent_id)
        self._streams_changed()  # it is registered under the new id
        for key in [key for key in self._running if key[1] == agent]:
            self._running.pop(key).cancel()
        forget = [Task(task.robot_id, _removal(task.node)) for task in before]
        forgotten = await self._try(forget, slow)
        for task in [*forget, *self._registrations.of_agent((agent[0], agent_id), self._robots())]:
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
        for task in self._registrations.of_agent(agent, self._robots()):
            self._start(task)

    def repeat_all(self) -> None:
        """Our own link was lost: robots may have seen our headsets leave, so tell them everything again."""
        for robot_id, group in self._robots().items():
            for task in self._registrations.of_robot(robot_id, group):
                self._start(task)

    def _robots(self) -> Robots:
        return {agent.id: agent.group for agent in self._directory.of_type(ROS)}

    def _streams_changed(self) -> None:
        """Streams of robots that are away stay: a reliable one goes on where it was when its robot is back."""
        self._seen.update(self._robots())
        self._on_streams(self._registrations.streams(NodeType.SUBSCRIBER, self._seen))

    def _start(self, task: Task) -> None:
        node = task.node
        key = (task.robot_id, (node.registrant_agent_type, node.registrant_agent_id), node.node_type, node.node_name)
        if (before := self._running.pop(key, None)) is not None:
            before.cancel()
        running = asyncio.get_running_loop().create_task(self._run(task))
        self._running[key] = running
        running.add_done_callback(lambda done: self._running.pop(key) if self._running.get(key) is done else None)

    async def _run(self, task: Task) -> None:
        node = task.node
        what = f"headset {node.registrant_agent_id}: {_describe(node)} on robot {task.robot_id}"
        for attempt in range(ATTEMPTS):
            try:
                await self._ask(task)
                log.info("%s: done", what)
                return
            except (Refused, OutOfRange) as refusal:  # by the robot, or here by a traffic rule
                log.warning("%s was refused: %s", what, refusal)
                self._refused(task, str(refusal))
                return
            except Unreachable as error:
                log.debug("%s: %s", what, error)
            await asyncio.sleep(RETRY_S[min(attempt, len(RETRY_S) - 1)])
            if isinstance(node, AddNode) and not self._registrations.holds(task, self._robots()):
                return  # taken back; or the robot is away, and is told everything when it returns
        log.warning("%s: the robot does not answer", what)

    def _refused(self, task: Task, reason: str) -> None:
        node = task.node
        if isinstance(node, AddNode):
            refused = NodeRefused(
                robot_id=task.robot_id,
                node_type=node.node_type,
                node_name=node.node_name,
                tos_name=node.tos_name,
                reason=reason,
            )
            self._on_refused((node.registrant_agent_type, node.registrant_agent_id), refused)

    async def _ask(self, task: Task) -> None:
        node = task.node
        sender = (node.registrant_agent_type, node.registrant_agent_id)
        verb = "add_node" if isinstance(node, AddNode) else "remove_node"
        metadata = Metadata(*sender, message_manager=node.manager)
        key, frame = call((ROS, task.robot_id), verb, sender, encode_data(node), metadata, self._layout)
        await self._mesh.query(key, frame, timeout_s=CALL_TIMEOUT_S)


def _removal(node: AddNode | RemoveNode) -> RemoveNode:
    return RemoveNode(node.registrant_agent_type, node.registrant_agent_id, node.node_type, node.node_name)


def _describe(node: AddNode | RemoveNode) -> str:
    kind = NodeType(node.node_type).name.lower() if node.node_type in list(NodeType) else f"node type {node.node_type}"
    verb = "add" if isinstance(node, AddNode) else "remove"
    return f"{verb} {kind} {getattr(node, 'tos_name', '') or node.node_name}"
