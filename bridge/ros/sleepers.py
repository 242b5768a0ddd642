"""Headsets whose connection has ended and who may come back: what they were moving stops at once."""

from __future__ import annotations

import asyncio

from bridge.ros.interface import Registrant
from bridge.ros.nodes import InterfaceNodes
from macs_zenoh.agent import Agent
from macs_zenoh.protocol.directory import AgentInfo

ON_ITS_WAY_S = 0.2
"""What somebody sent whose connection has ended has come by then."""


def stop_sleepers(agent: Agent, nodes: InterfaceNodes) -> None:
    """From now on, at every robot node: also what was still on its way stops."""

    def stop(sleeper: AgentInfo) -> None:
        if sleeper.asleep and agent.directory.get(*sleeper.key) == sleeper:
            nodes.fell_asleep(Registrant(sleeper.type, sleeper.id))

    def fell_asleep(sleeper: AgentInfo) -> None:
        stop(sleeper)
        asyncio.get_running_loop().call_later(ON_ITS_WAY_S, stop, sleeper)

    agent.on_asleep(fell_asleep)
