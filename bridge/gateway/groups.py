"""An agent of a gateway is seen by others: online, and in the group that it has told."""

from __future__ import annotations

import asyncio
import logging

from macs_zenoh.presence import Presence
from macs_zenoh.protocol.keyexpr import GROUP

from .agents import Agents, Group
from .connection import Connection
from .delivery import Delivery
from .departures import Departures
from .roll import Roll
from .subscriptions import Subscriptions

log = logging.getLogger("macs.gateway")

CALM_S = 0.25
"""So long after one change of its group an agent's next one is seen by others."""

OVERLAP_S = 0.1
"""How long an agent is seen in its former group as well: in no moment it seems to be gone."""


class Groups:
    """Those in which agents of one gateway are."""

    def __init__(
        self,
        agents: Agents,
        presence: Presence,
        subscriptions: Subscriptions,
        delivery: Delivery,
        roll: Roll,
        departures: Departures,
    ) -> None:
        self._agents = agents
        self._presence = presence
        self._subscriptions = subscriptions
        self._delivery = delivery
        self._roll = roll
        self._departures = departures

    def enter(self, connection: Connection) -> None:
        """Let others see an agent, in the group that it has told."""
        kind, agent_id = connection.key
        group = connection.peer.group
        if group:
            self._subscriptions.add(GROUP.every(type=kind, group=group), self._delivery.group)
        # the token last: whoever sees the agent can reach it
        epoch, asleep = self._agents.epoch(connection), connection.seen_asleep
        token = self._presence.declare(kind, agent_id, group, epoch, asleep=asleep, gather=True)
        connection.unseen = True
        before, emptied = self._agents.join(connection, token)
        self.emptied(emptied)
        loop = asyncio.get_running_loop()
        connection.grouped_at = loop.time()
        if before is not None:
            self.show(connection)
            loop.call_later(OVERLAP_S, before.close)
        self._delivery.forget()
        self._roll.changed()

    def show(self, connection: Connection) -> None:
        """What an agent says comes behind its presence, however many have come just before it."""
        connection.unseen = False
        if (token := self._agents.presence(connection)) is not None:
            self._presence.declare_now(token)

    def change(self, connection: Connection) -> None:
        """An agent is in another group. Of many changes others see the first at once, and then the last."""
        loop = asyncio.get_running_loop()
        due = connection.grouped_at + CALM_S
        if loop.time() < due:
            if connection.regrouping is None:
                connection.regrouping = loop.call_at(due, self.change, connection)
            return
        connection.regrouping = None
        if self._agents.group_of(connection) != connection.peer.group:
            self.enter(connection)
            log.debug("%s is in group %d", connection, connection.peer.group)

    def leave(self, connection: Connection) -> bool:
        """An agent has left; whether it was online. One whom others have not seen yet they never see; agents here may
        have been told of it, and are told that it is gone."""
        token = self._agents.presence(connection)
        if token is not None and (unseen := self._presence.unseen(token)) is not None:
            self._departures.tell([unseen], [])
        was_online, emptied = self._agents.leave(connection)
        self.emptied(emptied)
        return was_online

    def is_seen(self, connection: Connection) -> bool:
        """Whether others see it."""
        token = self._agents.presence(connection)
        return token is not None and self._presence.unseen(token) is None

    def emptied(self, group: Group | None) -> None:
        """Nobody of ours is in this group any more."""
        if group is not None:
            self._subscriptions.remove(GROUP.every(type=group[0], group=group[1]))
