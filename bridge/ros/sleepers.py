"""Headsets whose connection has ended and who may come back: what they were moving stops at once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from bridge.ros.interface import Registrant
from bridge.ros.nodes import InterfaceNodes
from macs_zenoh.agent import Agent
from macs_zenoh.protocol.directory import AgentInfo

ON_ITS_WAY_S = 0.2
"""What somebody sent whose connection has ended has come by then."""
ANSWERS_S = 1.0
"""So long ROS nodes wait for the answer of a service to a headset that sleeps."""


def stop_sleepers(agent: Agent, nodes: InterfaceNodes) -> None:
    """From now on, at every robot node: also what was still on its way stops."""

    def look(sleeper: AgentInfo, then: Callable[[Registrant], None]) -> None:
        if sleeper.asleep and agent.directory.get(*sleeper.key) == sleeper:
            then(Registrant(sleeper.type, sleeper.id))

    def fell_asleep(sleeper: AgentInfo) -> None:
        loop = asyncio.get_running_loop()
        look(sleeper, nodes.fell_asleep)
        loop.call_later(ON_ITS_WAY_S, look, sleeper, nodes.fell_asleep)
        loop.call_later(ANSWERS_S, look, sleeper, nodes.stays_asleep)

    agent.on_asleep(fell_asleep)
