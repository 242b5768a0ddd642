"""Who wants which interface node on which robots: what a gateway remembers for its headsets. Pure.

A registration names robots by id and by group. It holds until it is taken back or its headset leaves: robots that
come later, come back, or join a registered group get it as well. Nothing here costs more than what changes by it: a
headset that comes or leaves costs its own registrations, a robot those that are for it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from msgspec import structs

from ..errors import Refused
from .agent_id import AgentId
from .messages import AddNode, NodeType, RemoveNode

AgentKey = tuple[int, int]
"""(agent type, agent id), as of `AgentId`."""


class Task(NamedTuple):
    """Tell a robot to add or remove an interface node."""

    robot_id: int
    node: AddNode | RemoveNode


@dataclass(eq=False)
class _Wish:
    node: AddNode
    robot_ids: set[int] = field(default_factory=set)
    groups: set[int] = field(default_factory=set)
    held_by: dict[int, AgentKey] = field(default_factory=dict)
    """Robots that refused it because another agent has the node, and who: it keeps it until it leaves."""

    def covers(self, robot_id: int, group: int) -> bool:
        return robot_id in self.robot_ids or (group != 0 and group in self.groups)


Robots = dict[int, int]
"""Robots online: id → group."""

StreamKey = tuple[int, str]
"""(robot id, node name)."""

NodeKey = tuple[int, str]
"""(node type, node name)."""

SUBSCRIBER = int(NodeType.SUBSCRIBER)


class Registrations:
    """Every registration of a gateway's agents, and which topics of which robots are wanted for that.

    ``streams`` has who is registered on each topic of each robot that has been seen: one that is away for a while goes
    on where it was; one that nobody has ever seen costs nothing.
    """

    def __init__(self) -> None:
        self._of_agent: dict[AgentKey, dict[NodeKey, _Wish]] = {}
        self._by_id: dict[int, dict[_Wish, None]] = {}
        self._by_group: dict[int, dict[_Wish, None]] = {}
        self._count = 0
        self._named: Counter[AgentKey] = Counter()
        self._seen: Robots = {}
        self._members: dict[int, set[int]] = {}
        self._refused: set[_Wish] = set()
        self.streams: dict[StreamKey, set[AgentKey]] = {}
        self._told: dict[StreamKey, set[AgentKey]] = {}
        """Of these, which `wanted` has told."""
        self._gone: dict[StreamKey, None] = {}

    def __len__(self) -> int:
        return self._count

    def named(self, agent: AgentKey) -> int:
        """How many robots and groups an agent's registrations name, all together: what they cost here."""
        return self._named.get(agent, 0)

    def naming(self, node: AddNode, robot_ids: Iterable[int], groups: Iterable[int]) -> int:
        """How many more that would be with this one."""
        wish = self._find(node)
        known_ids, known_groups = (wish.robot_ids, wish.groups) if wish is not None else (set[int](), set[int]())
        return len(set(robot_ids) - known_ids) + len(set(groups) - known_groups)

    def add(self, node: AddNode, robot_ids: Iterable[int], groups: Iterable[int], robots: Robots) -> list[Task]:
        """Remember a registration and return what to tell now. Empty lists only repeat what is known."""
        agent, key = _keys(node)
        wish = self._of_agent.get(agent, {}).get(key)
        if wish is None:
            wish = _Wish(node)
            new_ids, new_groups = set(robot_ids), set(groups)
            if not new_ids and not new_groups:
                return []
            self._of_agent.setdefault(agent, {})[key] = wish
            self._count += 1
        else:
            new_ids, new_groups = set(robot_ids) - wish.robot_ids, set(groups) - wish.groups
            wish.node = node
            wish.held_by.clear()
            self._refused.discard(wish)
        self._named[agent] += len(new_ids) + len(new_groups)
        for robot_id in new_ids:
            self._by_id.setdefault(robot_id, {})[wish] = None
        for group in new_groups:
            self._by_group.setdefault(group, {})[wish] = None
        wish.robot_ids |= new_ids
        wish.groups |= new_groups
        for robot_id in self._seen_of(new_ids, new_groups):
            self._stream(wish, robot_id)
        return [Task(robot_id, node) for robot_id in _covered(wish, robots)]

    def remove(self, node: RemoveNode, robot_ids: Iterable[int], groups: Iterable[int], robots: Robots) -> list[Task]:
        """Take back a registration from these robots and groups; robots still covered otherwise keep it."""
        agent, key = _keys(node)
        wish = self._of_agent.get(agent, {}).get(key)
        if wish is None:
            return []
        before = _covered(wish, robots)
        gone_ids, gone_groups = wish.robot_ids.intersection(robot_ids), wish.groups.intersection(groups)
        self._named[agent] -= len(gone_ids) + len(gone_groups)
        touched = self._seen_of(gone_ids, gone_groups)
        self._unindex(wish, gone_ids, gone_groups)
        wish.robot_ids -= gone_ids
        wish.groups -= gone_groups
        for robot_id in touched:
            self._stream(wish, robot_id)
        if not wish.robot_ids and not wish.groups:
            self._forget(agent, key)
        after = set(_covered(wish, robots))
        return [Task(robot_id, node) for robot_id in before if robot_id not in after]

    def leave(self, agent: AgentKey) -> None:
        """Forget everything an agent registered. Robots notice its end by themselves."""
        self._named.pop(agent, None)
        for key, wish in list(self._of_agent.get(agent, {}).items()):
            self._unindex(wish, wish.robot_ids, wish.groups)
            if wish.node.node_type == SUBSCRIBER:
                for robot_id in self._seen_of(wish.robot_ids, wish.groups):
                    self._unregister((robot_id, wish.node.node_name), agent)
            self._forget(agent, key)

    def rename(self, agent: AgentKey, agent_id: int) -> None:
        """An agent has another id now: its registrations are those of the new one."""
        wishes = self._of_agent.pop(agent, {})
        after = (agent[0], agent_id)
        self._named[after] = self._named.pop(agent, 0)
        if wishes:
            self._of_agent[after] = wishes
        for wish in wishes.values():
            wish.node = structs.replace(wish.node, registrant_agent_id=agent_id)
            if wish.node.node_type == SUBSCRIBER:
                for robot_id in self._seen_of(wish.robot_ids, wish.groups):
                    self._unregister((robot_id, wish.node.node_name), agent)
                    self._stream(wish, robot_id)

    def seen(self, robot_id: int, group: int) -> list[Task]:
        """A robot is there, in this group: known from now on. What it was told for a group that it has left is to be
        taken back."""
        before = self._seen.get(robot_id)
        if before == group:
            return []
        self._seen[robot_id] = group
        if before:
            self._members[before].discard(robot_id)
        if group:
            self._members.setdefault(group, set()).add(robot_id)
        left = [wish for wish in self._by_group.get(before or 0, ()) if before and not wish.covers(robot_id, group)]
        for wish in [*left, *self._of_robot(robot_id, group)]:
            self._stream(wish, robot_id)
        return [Task(robot_id, removal(wish.node)) for wish in left]

    def of_agent(self, agent: AgentKey, robots: Robots) -> list[Task]:
        """All that robots have to know of an agent."""
        return [
            Task(robot_id, wish.node)
            for wish in self._of_agent.get(agent, {}).values()
            for robot_id in _covered(wish, robots)
        ]

    def of_robot(self, robot_id: int, group: int) -> list[Task]:
        """All that a robot has to be told when it comes, comes back or changes its group. What it refused because
        another agent has it is not asked again: who holds it keeps it."""
        return [Task(robot_id, w.node) for w in self._of_robot(robot_id, group) if robot_id not in w.held_by]

    def holds(self, task: Task, robots: Robots) -> bool:
        """Whether a task is still wanted: its robot online and its registration not taken back."""
        wish = self._find(task.node)
        return wish is not None and task.robot_id in robots and wish.covers(task.robot_id, robots[task.robot_id])

    def find(self, agent: AgentKey, node_type: int, node_name: str) -> AddNode | None:
        """An agent's registration of a node, None when it has none."""
        wish = self._of_agent.get(agent, {}).get((node_type, node_name))
        return wish.node if wish else None

    def registered(self, agent: AgentKey, node_type: int, node_name: str, robot_id: int) -> bool:
        """Whether an agent registered a node on this robot, by its id or its group."""
        wish = self._of_agent.get(agent, {}).get((node_type, node_name))
        return wish is not None and wish.covers(robot_id, self._seen.get(robot_id, 0))

    def where(self, agent: AgentKey, node_type: int, node_name: str) -> tuple[list[int], list[int]]:
        """The robots and groups on which an agent registered a node."""
        wish = self._of_agent.get(agent, {}).get((node_type, node_name))
        return (list(wish.robot_ids), list(wish.groups)) if wish is not None else ([], [])

    def refused(self, task: Task, holder: AgentKey) -> None:
        """A robot refused a registration because another agent has the node."""
        wish = self._find(task.node)
        if wish is not None:
            wish.held_by[task.robot_id] = holder
            self._refused.add(wish)

    def holder_left(self, agent: AgentKey, robots: Robots) -> list[Task]:
        """An agent has left: what was refused because of it can be asked again."""
        tasks = []
        for wish in list(self._refused):
            freed = [robot_id for robot_id, holder in wish.held_by.items() if holder == agent]
            for robot_id in freed:
                del wish.held_by[robot_id]
                if robot_id in robots and wish.covers(robot_id, robots[robot_id]):
                    tasks.append(Task(robot_id, wish.node))
            if not wish.held_by:
                self._refused.discard(wish)
        return tasks

    def wanted(self, key: StreamKey) -> set[AgentKey] | None:
        """Who is registered on a robot's topic, as it is from now on, if that was not told before. It is asked when it
        matters: what a topic needs costs time, and one may register on thousands."""
        registrants = self.streams.get(key)
        if registrants is None or self._told.get(key) is registrants:
            return None
        self._told[key] = registrants
        return registrants

    def gone(self) -> Iterator[StreamKey]:
        """Streams of which `wanted` has told, and that nobody wants any more since this was asked last."""
        gone, self._gone = self._gone, {}
        for key in gone:
            if key not in self.streams:
                del self._told[key]
                yield key

    # -- inside --------------------------------------------------------------------------------------------------

    def _find(self, node: AddNode | RemoveNode) -> _Wish | None:
        agent, key = _keys(node)
        return self._of_agent.get(agent, {}).get(key)

    def _of_robot(self, robot_id: int, group: int) -> list[_Wish]:
        named = self._by_id.get(robot_id, {})
        grouped = self._by_group.get(group, {}) if group else {}
        return list({**named, **grouped})

    def _seen_of(self, robot_ids: Iterable[int], groups: Iterable[int]) -> set[int]:
        """Robots that have been seen and are named, by id or by group."""
        return {r for r in robot_ids if r in self._seen}.union(*(self._members.get(group, ()) for group in groups))

    def _stream(self, wish: _Wish, robot_id: int) -> None:
        """See that somebody is registered on a robot's topic, or is not, as it is wished now."""
        node = wish.node
        if node.node_type != SUBSCRIBER:
            return
        agent = (node.registrant_agent_type, node.registrant_agent_id)
        key = (robot_id, node.node_name)
        if not wish.covers(robot_id, self._seen[robot_id]):
            self._unregister(key, agent)
        elif key in self.streams:
            self.streams[key].add(agent)
        else:
            self.streams[key] = {agent}

    def _unregister(self, key: StreamKey, agent: AgentKey) -> None:
        registrants = self.streams.get(key)
        if registrants is not None:
            registrants.discard(agent)
            if not registrants:
                del self.streams[key]
                if key in self._told:
                    self._gone[key] = None

    def _unindex(self, wish: _Wish, robot_ids: Iterable[int], groups: Iterable[int]) -> None:
        for index, names in ((self._by_id, robot_ids), (self._by_group, groups)):
            for name in names:
                del index[name][wish]
                if not index[name]:
                    del index[name]

    def _forget(self, agent: AgentKey, key: NodeKey) -> None:
        wishes = self._of_agent[agent]
        self._refused.discard(wishes.pop(key))
        self._count -= 1
        if not wishes:
            del self._of_agent[agent]


def removal(node: AddNode | RemoveNode) -> RemoveNode:
    """What takes a registration back."""
    return RemoveNode(node.registrant_agent_type, node.registrant_agent_id, node.node_type, node.node_name)


def check_own(node: AddNode | RemoveNode, caller: AgentKey) -> None:
    """A registration is for whoever calls: the key says who that is, and routers hold callers to their keys.

    Raises Refused.
    """
    registrant = (node.registrant_agent_type, node.registrant_agent_id)
    if registrant != caller:
        raise Refused(f"{AgentId(*caller)} cannot register or remove nodes for {AgentId(*registrant)}")


def _keys(node: AddNode | RemoveNode) -> tuple[AgentKey, NodeKey]:
    return (node.registrant_agent_type, node.registrant_agent_id), (node.node_type, node.node_name)


def _covered(wish: _Wish, robots: Robots) -> list[int]:
    """The robots online that a registration is for; by id alone it costs what it names, not what there is."""
    if not wish.groups and len(wish.robot_ids) < len(robots):
        return [robot_id for robot_id in sorted(wish.robot_ids) if robot_id in robots]
    return [robot_id for robot_id, group in robots.items() if wish.covers(robot_id, group)]
