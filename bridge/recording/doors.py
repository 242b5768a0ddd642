"""Who came by which token, as gateways tell: so that a recording says whose hand a headset was. Asyncio."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import NamedTuple

from bridge.recording.conditions import Event
from bridge.recording.streams import TOKENS
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.keyexpr import PING
from macs_zenoh.protocol.messages import ROS

log = logging.getLogger("macs.record")

ANSWER_S = 2.0
PAUSE_S = 0.5
"""Many that come at once are asked for once."""
SESSIONS = 256
"""So many gateways are asked; who comes by others is known by id alone."""
KNOWN = 1 << 16


class _Known(NamedTuple):
    """What a gateway told of an agent, while that was one of its own."""

    token: str
    address: str
    session: tuple[str, int]


class Doors:
    """Asks the gateways of those who come. ``put`` takes what is new."""

    def __init__(self, agent: Agent, put: Callable[[Event], None]) -> None:
        self._agent = agent
        self._put = put
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._came: dict[str, set[AgentId]] = {}
        """Who came by a session after it was asked: what it answers may be of who had the id before."""
        self._known: dict[str, _Known] = {}

    async def token(self, agent: str) -> str:
        """The name of the token by which an agent (``unity/256``) came; empty where none is known, once gateways that
        are being asked have answered."""
        if agent not in self._known and self._asking:
            await asyncio.wait(list(self._asking.values()), timeout=PAUSE_S + ANSWER_S)
        known = self._known.get(agent)
        return "" if known is None else known.token

    def came(self, agent: AgentInfo) -> None:
        """Somebody is online."""
        if agent.zid == self._agent.mesh.zid or agent.type == ROS:
            return
        if (known := self._known.get(str(agent.key))) is not None and known.session != agent.session:
            del self._known[str(agent.key)]
        if agent.zid in self._asking:
            self._came.setdefault(agent.zid, set()).add(agent.key)
        elif len(self._asking) < SESSIONS:
            self._asking[agent.zid] = asyncio.get_running_loop().create_task(self._ask(agent.zid))

    def left(self, agent: AgentInfo) -> None:
        """Somebody is not any more: whoever has the id next may come by another token."""
        self._known.pop(str(agent.key), None)

    def close(self) -> None:
        """Ask nobody any more."""
        for task in self._asking.values():
            task.cancel()

    async def _ask(self, zid: str) -> None:
        try:
            while True:
                await asyncio.sleep(PAUSE_S)
                self._came.pop(zid, None)
                answer = await self._agent.mesh.query(PING.of(zid=zid), ping.AGENTS, timeout_s=ANSWER_S)
                self._told(zid, ping.decode_told(ping.decode(answer)[1]))
                if zid not in self._came:
                    return
        except MacsError as error:  # no gateway, an old one, or it may not be asked
            log.debug("%s does not tell who its agents are: %s", zid, error)
        finally:
            self._came.pop(zid, None)
            del self._asking[zid]

    def _told(self, zid: str, told: ping.GatewayTold) -> None:
        """Only of those who are online by this session: whoever is asked could name others, or who has left."""
        came = self._came.get(zid, ())
        for each in told.agents:
            key, there = AgentId(each.type, each.id), self._agent.directory.get(each.type, each.id)
            if there is None or there.zid != zid or key in came:
                continue
            agent, said = str(key), _Known(each.token, each.address, there.session)
            if self._known.get(agent) == said or (agent not in self._known and len(self._known) >= KNOWN):
                continue
            self._known[agent] = said
            value = {"agent": agent, "token": each.token, "address": each.address, "gateway": zid}
            self._put(Event(TOKENS, value, keep=f"{TOKENS} {agent}"))
