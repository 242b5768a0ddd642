"""Who wants which interface node on which robots: what a gateway remembers for its headsets. Pure.

A registration names robots by id and by group. It holds until it is taken back or its headset leaves: robots that
come later, come back, or join a registered group get it as well.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from msgspec import structs

from .errors import Refused
from .keyexpr import type_name
from .messages import AddNode, RemoveNode

AgentKey = tuple[int, int]
"""(agent type, agent id)."""


class Task(NamedTuple):
    """Tell a robot to add or remove an interface node."""

    robot_id: int
    node: AddNode | RemoveNode


@dataclass
class _Wish:
    node: AddNode
    robot_ids: set[int] = field(default_factory=set)
    groups: set[int] = field(default_factory=set)

    def covers(self, robot_id: int, group: int) -> bool:
        return robot_id in self.robot_ids or (group != 0 and group in self.groups)


Robots = dict[int, int]
"""Robots online: id → group."""

Streams = dict[tuple[int, str], set[AgentKey]]
"""(robot id, node name) → who is registered there."""


class Registrations:
    """Every registration of a gateway's agents."""

    def __init__(self) -> None:
        self._wishes: dict[tuple[AgentKey, int, str], _Wish] = {}

    def __len__(self) -> int:
        return len(self._wishes)

    def add(self, node: AddNode, robot_ids: Iterable[int], groups: Iterable[int], robots: Robots) -> list[Task]:
        """Remember a registration and return what to tell now. Empty lists only repeat what is known."""
        key = _key(node)
        wish = self._wishes.setdefault(key, _Wish(node))
        wish.node = node
        wish.robot_ids.update(robot_ids)
        wish.groups.update(groups)
        if not wish.robot_ids and not wish.groups:
            del self._wishes[key]
        return [Task(robot_id, node) for robot_id in _covered(wish, robots)]

    def remove(self, node: RemoveNode, robot_ids: Iterable[int], groups: Iterable[int], robots: Robots) -> list[Task]:
        """Take back a registration from these robots and groups; robots still covered otherwise keep it."""
        key = _key(node)
        wish = self._wishes.get(key)
        if wish is None:
            return []
        before = _covered(wish, robots)
        wish.robot_ids.difference_update(robot_ids)
        wish.groups.difference_update(groups)
        if not wish.robot_ids and not wish.groups:
            del self._wishes[key]
        after = set(_covered(wish, robots))
        return [Task(robot_id, node) for robot_id in before if robot_id not in after]

    def leave(self, agent: AgentKey) -> None:
        """Forget everything an agent registered. Robots notice its end by themselves."""
        self._wishes = {key: wish for key, wish in self._wishes.items() if key[0] != agent}

    def rename(self, agent: AgentKey, agent_id: int) -> None:
        """An agent has another id now: its registrations are those of the new one."""
        renamed = {}
        for (owner, node_type, node_name), wish in self._wishes.items():
            if owner == agent:
                owner = (agent[0], agent_id)
                wish.node = structs.replace(wish.node, registrant_agent_id=agent_id)
            renamed[owner, node_type, node_name] = wish
        self._wishes = renamed

    def of_agent(self, agent: AgentKey, robots: Robots) -> list[Task]:
        """All that robots have to know of an agent."""
        return [
            Task(robot_id, wish.node)
            for (owner, _, _), wish in self._wishes.items()
            if owner == agent
            for robot_id in _covered(wish, robots)
        ]

    def of_robot(self, robot_id: int, group: int) -> list[Task]:
        """All that a robot has to be told when it comes, comes back or changes its group."""
        return [Task(robot_id, wish.node) for wish in self._wishes.values() if wish.covers(robot_id, group)]

    def holds(self, task: Task, robots: Robots) -> bool:
        """Whether a task is still wanted: its robot online and its registration not taken back."""
        wish = self._wishes.get(_key(task.node))
        return wish is not None and task.robot_id in robots and wish.covers(task.robot_id, robots[task.robot_id])

    def find(self, agent: AgentKey, node_type: int, node_name: str) -> AddNode | None:
        """An agent's registration of a node, None when it has none."""
        wish = self._wishes.get((agent, node_type, node_name))
        return wish.node if wish else None

    def streams(self, node_type: int, robots: Robots) -> Streams:
        """Every stream that somebody here is registered for, and who is."""
        streams: Streams = {}
        for (agent, kind, name), wish in self._wishes.items():
            if kind == node_type:
                for robot_id in wish.robot_ids.union(_covered(wish, robots)):
                    streams.setdefault((robot_id, name), set()).add(agent)
        return streams


def check_own(node: AddNode | RemoveNode, caller: AgentKey) -> None:
    """A registration is for whoever calls: the key says who that is, and routers hold callers to their keys.

    Raises Refused.
    """
    registrant = (node.registrant_agent_type, node.registrant_agent_id)
    if registrant != caller:
        raise Refused(f"{_named(caller)} cannot register or remove nodes for {_named(registrant)}")


def _named(agent: AgentKey) -> str:
    return f"{type_name(agent[0])}/{agent[1]}"


def _key(node: AddNode | RemoveNode) -> tuple[AgentKey, int, str]:
    return ((node.registrant_agent_type, node.registrant_agent_id), node.node_type, node.node_name)


def _covered(wish: _Wish, robots: Robots) -> list[int]:
    return [robot_id for robot_id, group in robots.items() if wish.covers(robot_id, group)]
