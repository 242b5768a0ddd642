"""Other ids for TCP agents: when two parts of a mesh meet that could not see each other, both may have given out the
same ones.

A headset takes a later AgentConfigurer as its new id, at any time and without a reconnection (docs/protocol.md). Its
robots are told the new id before the change and the old one is taken back after it, so that each message of a topic
comes once. A robot program is not told: it needs no id of its own, as the gateway writes the true sender into all that
it sends; so it keeps the id that headsets know it by unless another robot has that id as well.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable

from macs_zenoh.claims import Disputes
from macs_zenoh.presence import Contested, Presence
from macs_zenoh.protocol.ids import Contests, Verdict
from macs_zenoh.protocol.keyexpr import block_of
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.registrations import AgentKey, Task
from macs_zenoh.registration_calls import RobotCalls

from .agents import Agents
from .connection import Connection
from .declarations import AgentDeclarations
from .leases import Leases

log = logging.getLogger("macs.gateway")

GATHER_S = 0.2
"""How long the first news of ids that others have waits for more: a block lost changes them all at once."""

AT_ONCE = 64
"""How many agents change their id at the same time."""

AGAIN_S = 5.0
"""Pause after an attempt to change ids that failed as a whole."""

ANSWER_S = 5.0
"""How long answers of services are still taken under the old id: as long as existing headsets wait for them."""


class Renumbering:
    """Watches for ids of ours that others have, and for blocks that are no longer ours, and changes ids.

    ``on_change(connection)`` is called just before a connection has another id, ``on_block_left(block)`` when nobody
    needs what is sent to a former block.
    """

    def __init__(
        self,
        zid: str,
        presence: Presence,
        agents: Agents,
        leases: Leases,
        robots: RobotCalls,
        declarations: AgentDeclarations,
        *,
        on_change: Callable[[Connection], None],
        on_block_left: Callable[[int], None],
    ) -> None:
        self._zid = zid
        self._presence = presence
        self._agents = agents
        self._leases = leases
        self._robots = robots
        self._declarations = declarations
        self._on_change = on_change
        self._on_block_left = on_block_left
        self._disputes = Disputes(Contests[AgentKey](zid, lambda agent: False, leases.has_lease), self._judged)
        self._wanted: dict[Connection, None] = {}
        self._working: asyncio.Task[None] | None = None
        self._timers: set[asyncio.TimerHandle] = set()

    def close(self) -> None:
        """Change nothing any more."""
        if self._working is not None:
            self._working.cancel()
        self._disputes.close()
        for timer in self._timers:
            timer.cancel()

    # -- who has to change ---------------------------------------------------------------------------------------

    def contested(self, contested: Contested) -> None:
        """What others claim of what this session holds."""
        ours = {agent: others for agent, others in contested.items() if self._agents.find(*agent)}
        for agent in self._disputes.look(ours):
            if self._agents.find(*agent):
                # the other has left the id to ours, and on robots may have taken back what was registered under it
                self._robots.repeat(agent)

    def _judged(self, verdicts: list[Verdict[AgentKey]]) -> None:
        found = [self._agents.find(*verdict.what) for verdict in verdicts]
        self._want(connection for connection in found if connection is not None)

    def block_lost(self, block: int) -> None:
        """A block is another gateway's: everybody in it gets an id of another one, except robots."""
        self._want(c for c in self._agents.online() if c.key[0] != ROS and block_of(c.agent_id) == block)
        self._later(ANSWER_S, lambda: self._leave_block(block))

    def joined(self, connection: Connection) -> None:
        """An agent is online; it may have got its id from a block that was lost meanwhile."""
        if connection.key[0] != ROS and block_of(connection.agent_id) not in self._leases.blocks:
            self._want([connection])

    def _leave_block(self, block: int) -> None:
        if block in self._leases.blocks:
            return  # leased again
        inside = [agent_id for agent_id in self._agents.ids if block_of(agent_id) == block]
        if any(self._agents.needs_block(agent_id) for agent_id in inside):
            self._later(ANSWER_S, lambda: self._leave_block(block))
        else:
            self._on_block_left(block)

    # -- the change ----------------------------------------------------------------------------------------------

    def _want(self, connections: Iterable[Connection]) -> None:
        self._wanted.update(dict.fromkeys(connections))
        if self._wanted and self._working is None:
            self._working = asyncio.get_running_loop().create_task(self._work())

    async def _work(self) -> None:
        try:
            await asyncio.sleep(GATHER_S)
            while self._wanted:
                wanted, self._wanted = sorted(filter(self._must_change, self._wanted), key=lambda c: c.agent_id), {}
                try:
                    await self._move_all(wanted)
                except Exception:
                    log.exception("%d agents here keep ids that others have; trying again", len(wanted))
                    self._wanted.update(dict.fromkeys(wanted))
                    await asyncio.sleep(AGAIN_S)
        finally:
            self._working = None

    async def _move_all(self, wanted: list[Connection]) -> None:
        if not wanted:
            return
        slow: set[int] = set()  # robots that do not answer: waited for once, not by everybody
        room = asyncio.Semaphore(AT_ONCE)
        ids = await self._reserve(len(wanted))
        moves = (self._move(agent, new, slow, room) for agent, new in zip(wanted, ids, strict=True))
        ends = await asyncio.gather(*moves, return_exceptions=True)
        failures = [(agent, end) for agent, end in zip(wanted, ends, strict=True) if isinstance(end, Exception)]
        for agent, error in failures:
            log.error("%s: the change of its id failed", agent, exc_info=error)
        if moved := len(wanted) - len(failures):
            log.warning("%d agents here have other ids now: another gateway had given out theirs", moved)

    def _must_change(self, connection: Connection) -> bool:
        """Whether it is still there, and under an id that it cannot keep: it may be moved already for another
        reason."""
        kind, agent_id = connection.key
        if self._agents.find(kind, agent_id) is not connection:
            return False
        return connection.key in self._disputes or (kind != ROS and block_of(agent_id) not in self._leases.blocks)

    async def _reserve(self, count: int) -> list[int]:
        """So many free ids of our blocks; more blocks are leased for them if need be."""
        ids: list[int] = []
        try:
            while len(ids) < count:
                agent_id = self._leases.take_id(self._is_elsewhere, wanting=count - len(ids))
                if agent_id is None:
                    await self._leases.more()
                else:
                    ids.append(agent_id)
        except BaseException:
            for agent_id in ids:
                self._leases.give_back(agent_id)
            raise
        return ids

    def _is_elsewhere(self, agent_id: int) -> bool:
        return self._presence.directory.is_elsewhere(agent_id, self._zid)

    async def _move(self, connection: Connection, new_id: int, slow: set[int], room: asyncio.Semaphore) -> None:
        async with room:
            try:
                old = connection.key
                tasks = self._robots.to_prepare(old, new_id) if old[0] != ROS else []
                told = await self._robots.prepare(tasks, slow)
                if self._agents.find(*old) is connection:
                    await self._change(connection, new_id, told, slow)
                else:  # it has left meanwhile
                    self._robots.take_back(tasks)
            finally:
                if connection.agent_id != new_id:
                    self._leases.give_back(new_id)

    async def _change(self, connection: Connection, new_id: int, told: list[Task], slow: set[int]) -> None:
        old = connection.key
        before = str(connection)
        self._on_change(connection)
        self._agents.renumber(connection, new_id)
        self._declarations.declare(connection)
        group, epoch = self._agents.group_of(connection), self._agents.epoch(connection)
        token = self._presence.declare(old[0], new_id, group, epoch, asleep=connection.seen_asleep)
        old_token = self._agents.replace_token(connection, token)
        log.info("%s has id %d now", before, new_id)
        self._later(ANSWER_S, lambda: self._forget_former(old, connection))
        if old[0] == ROS:
            # who registered on a robot program asked for its old id, which is another robot's now
            connection.tell_gone(connection.recipient.robot_nodes.registrants())
        else:
            connection.send_call(connection.peer.welcome())
            await self._robots.rename(old, new_id, told, slow)
        self._declarations.undeclare(old)
        old_token.close()

    def _forget_former(self, old: AgentKey, connection: Connection) -> None:
        self._agents.forget_former(old, connection)
        self._leases.give_back(old[1])

    def _later(self, delay_s: float, then: Callable[[], None]) -> None:
        def run() -> None:
            self._timers.discard(timer)
            then()

        timer = asyncio.get_running_loop().call_later(delay_s, run)
        self._timers.add(timer)
