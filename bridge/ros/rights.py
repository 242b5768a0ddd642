"""Who may act on a robot, asked each time somebody does: to register is not the only way in. Pure.

A registration is a call whose payload no router can judge, and existing programs send commands and service calls
without one. So every message to an interface node that acts (types 2 to 5), every request for control and every
registration is held to ``register_allow``.
"""

from __future__ import annotations

from collections.abc import Callable

from bridge.ros.interface import Registrant
from bridge.ros.rules import names_agent
from bridge.settings import RobotSettings
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.keyexpr import type_name, type_number

EVERYBODY = "*"


class Rights:
    """The settings' ``register_allow``, and what was found by them. ``group_of`` an agent counts for rights."""

    KNOWN = 4096

    def __init__(self, settings: RobotSettings, group_of: Callable[[Registrant], int]) -> None:
        self._allow = settings.register_allow
        self._group_of = group_of
        self._everybody = EVERYBODY in self._allow
        self._known: dict[tuple[str, int], bool] = {}

    def may_act(self, agent_type: str, agent_id: int) -> bool:
        """Whether an agent may command, call, serve and give goals. From any thread."""
        if self._everybody:
            return True
        results = self._known  # what is found out now is not remembered when `changed` comes meanwhile
        known = results.get((agent_type, agent_id))
        if known is None:
            group = self._group_of(Registrant(int(type_number(agent_type)), agent_id))
            known = names_agent(self._allow, agent_type, agent_id, group)
            if len(results) >= self.KNOWN:  # ids come from the network
                results.clear()
            results[agent_type, agent_id] = known
        return known

    def check(self, agent: Registrant) -> None:
        """Raise Refused when it may not act."""
        named = names_agent(self._allow, type_name(agent.type), agent.id, self._group_of(agent))
        if not named:
            raise Refused(f"{agent} may only register for topics that this robot sends, and not act on it")

    def changed(self) -> None:
        """Somebody came, left, or is in another group: what was found may hold no longer."""
        self._known = {}
