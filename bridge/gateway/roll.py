"""Who is online, as the agents of a gateway are told it: of robots only those with which their token has to do."""

from __future__ import annotations

from collections.abc import Callable

from macs_zenoh.presence import Presence
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.messages import ROS, UNITY, AgentsGone, GoneAgent, OnlineReply, encode_data
from macs_zenoh.protocol.recipient import to_agent
from macs_zenoh.protocol.rights import Rights

from .agents import Agents
from .connection import Connection

Robots = list[tuple[int, int]]
"""Id and group of each."""

KNOWN = 64
"""So many tokens' answers are kept until somebody comes or leaves."""


class Roll:
    """For all agents of a gateway."""

    def __init__(self, presence: Presence, agents: Agents) -> None:
        self._presence = presence
        self._agents = agents
        self._answers: dict[str, tuple[Rights | None, bytes]] = {}
        """By the token's name, empty without one."""

    def changed(self) -> None:
        """Somebody came, left, or is in another group."""
        self._answers.clear()

    def answer(self, connection: Connection) -> bytes:
        """What an agent is told that asks."""
        grant = connection.peer.grant
        known = self._answers.get(grant.name)
        if known is not None and known[0] == grant.rights:
            return known[1]
        robots = [(agent.id, agent.group) for agent in self._presence.elsewhere(ROS)]
        headsets = {agent.id for agent in self._presence.elsewhere(UNITY)}
        for own in self._agents.online():  # what we know ourselves comes back through the mesh a moment later
            if own.key[0] == ROS:
                robots.append((own.agent_id, self._agents.group_of(own)))
            elif own.key[0] == UNITY:
                headsets.add(own.agent_id)
        seen = {robot for robot, group in robots if grant.rights is None or grant.rights.sees(robot, group)}
        reply = encode_data(OnlineReply(ros_agent_ids=sorted(seen), unity_agent_ids=sorted(headsets)))
        if len(self._answers) >= KNOWN:
            self._answers.clear()
        self._answers[grant.name] = grant.rights, reply
        return reply

    def telling(self, gone: list[AgentInfo]) -> Callable[[Connection], None]:
        """What tells one agent that these have left."""
        agents = [GoneAgent(agent.type, agent.id) for agent in gone]
        message = to_agent(AgentsGone(agents))

        def tell(connection: Connection) -> None:
            if connection.has_ended:  # with those who left: it is forgotten in its turn
                return
            rights = connection.peer.grant.rights
            if rights is None or connection.key[0] != UNITY:
                connection.recipient.gone(agents)
                connection.send_call(message)
                return
            told = [
                GoneAgent(agent.type, agent.id)
                for agent in gone
                if agent.type != ROS or rights.sees(agent.id, agent.group)
            ]
            if told:
                connection.recipient.gone(told)
                connection.send_call(to_agent(AgentsGone(told)))

        return tell
