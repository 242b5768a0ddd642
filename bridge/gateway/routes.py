"""Where the frames of one connection go: worked out once for each destination that its headers name."""

from __future__ import annotations

from collections.abc import Callable, Container
from typing import NamedTuple

from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.messages import EVERYBODY, ROS
from macs_zenoh.protocol.registrations import AgentKey
from macs_zenoh.protocol.routing import keys_of
from macs_zenoh.protocol.wire import Frames, Header

KNOWN_ROUTES = 4096

STRANGERS_PER_S = 64.0
"""Agents that are not online, and groups that were not named before, to which frames of one connection go anyway: one
who has just come is known a moment later, and what an agent makes up must not cost others their time."""


class Route(NamedTuple):
    """Where frames with one destination go."""

    keys: list[str]
    agents: list[AgentKey]
    """Whom the frames name by id."""
    limited: bool = False
    """Whether a traffic rule limits one of the keys, so that frames count one by one."""
    left_out: int = 0
    """Destinations that were too many strangers."""
    to_robots: bool = False
    """Whether robots are among those it goes to."""
    name: str = ""
    """Equal for routes with the same keys."""
    apart: bool = False
    """Whether it is one agent, by its id: frames on another such route reach nobody that this one does."""


class Routes:
    """Those of one connection. ``online`` has the agents that are known, ``is_limited`` says whether a key is."""

    def __init__(self, online: Container[AgentKey], is_limited: Callable[[str], bool], now: float) -> None:
        self._online = online
        self._is_limited = is_limited
        self._known: dict[bytes, Route] = {}
        self._groups: set[tuple[int, int]] = set()
        self._agents: set[AgentKey] = set()
        self._everybody = False
        self._strangers = Credit(STRANGERS_PER_S, now)

    def find(self, destination: bytes) -> Route | None:
        """The route of frames with this `Frame.destination`, if it was worked out before."""
        return self._known.get(destination)

    def work_out(self, frame: Frames, sender: AgentKey, now: float) -> Route:
        """The route of a frame."""
        header, left_out = self._without_strangers(frame.header, now)
        keys = keys_of(header, *sender)
        # type 0 goes to everybody, whatever ids it names
        agents = [(header.agent_type, agent_id) for agent_id in header.ids] if header.agent_type else []
        self._agents.update(agents)
        self._everybody = self._everybody or header.agent_type == EVERYBODY
        limited = any(self._is_limited(key) for key in keys)
        to_robots = header.agent_type in (ROS, EVERYBODY)
        apart = len(keys) == 1 and len(agents) > 0
        route = Route(keys, agents, limited, left_out, to_robots, " ".join(keys), apart)
        if not left_out:
            if len(self._known) >= KNOWN_ROUTES:
                self._known.clear()
                self._agents = set(agents)
            self._known[frame.destination] = route
        return route

    def reach(self, agent: AgentInfo) -> bool:
        """Whether frames of the connection go, or went, to an agent, by its id, its group or with everybody."""
        return self._everybody or agent.key in self._agents or (agent.type, agent.group) in self._groups

    def forget(self) -> None:
        """The connection has another id: everything it sends has other keys."""
        self._known.clear()

    def _without_strangers(self, header: Header, now: float) -> tuple[Header, int]:
        """The header without destinations that nobody has, and how many these are, when there have been too many."""
        kind = header.agent_type
        if kind == EVERYBODY:
            return header, 0
        ids = [agent_id for agent_id in header.ids if (kind, agent_id) in self._online]
        groups = [group for group in header.groups if (kind, group) in self._groups]
        strangers = len(header.ids) - len(ids) + len(header.groups) - len(groups)
        if not strangers:
            return header, 0
        if self._strangers.take(strangers, now):
            self._groups.update((kind, group) for group in header.groups)
            return header, 0
        return header._replace(ids=tuple(ids), groups=tuple(groups)), strangers
