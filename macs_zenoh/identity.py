"""How an agent comes by its id and keeps it, or gives it up for another. Asyncio.

An id is configured or leased; `claims` has what holds for all that several may claim.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from .claims import Disputes, settle, stale_until
from .errors import MacsError, OutOfRange, Unreachable, UsageError
from .mesh import Mesh, Subscription
from .presence import Contested, Presence
from .protocol.agent_id import AgentId
from .protocol.ids import Contests, Verdict, free_id
from .protocol.keyexpr import LEASE, type_name
from .timeouts import within

log = logging.getLogger("macs.agent")

AGAIN_S = 5.0
"""After so long an agent that found no other id looks again."""


class _Claim(NamedTuple):
    """What is declared under one id."""

    id: int
    declared: tuple[Subscription, ...]

    def close(self) -> None:
        """Not online under this id any more; what is on its way to it is not received."""
        for declared in self.declared:
            declared.close()


class Identity:
    """The id of one agent. ``listen(id)`` subscribes its inbox; ``on_id(old, new)`` hears when it had to change.

    It changes when two parts of a mesh meet that could not see each other, and both had leased the same id.
    """

    def __init__(
        self,
        mesh: Mesh,
        presence: Presence,
        agent_type: int,
        group: int,
        *,
        listen: Callable[[int], Subscription],
        on_id: Callable[[int, int], None],
    ) -> None:
        self._mesh = mesh
        self._presence = presence
        self._type = agent_type
        self._group = group
        self._listen = listen
        self._on_id = on_id
        self._claim: _Claim | None = None
        self._is_fixed = False
        self._disputes = Disputes(Contests[tuple[int, int]](mesh.zid, lambda key: self._is_fixed), self._judged)
        self._changing: asyncio.Task[None] | None = None

    def __str__(self) -> str:
        return str(AgentId(self._type, self._claim.id if self._claim else 0))

    async def take(self, wanted: int | None) -> int:
        """Be online under the id wanted, or a free one. Raises UsageError when it is taken, Unreachable when all
        are."""
        self._is_fixed = wanted is not None
        self._claim = await (self._lease() if wanted is None else self._take_fixed(wanted))
        self.contested(self._presence.contested())
        return self._claim.id

    def hide(self) -> None:
        """Be offline until `show`. The inbox stays, as when the link is lost."""
        if self._claim is not None:
            self._claim.declared[0].close()

    def show(self) -> None:
        """Be online again."""
        if self._claim is not None:
            token = self._presence.declare(self._type, self._claim.id, self._group)
            self._claim = self._claim._replace(declared=(token, *self._claim.declared[1:]))

    def close(self) -> None:
        """Be offline."""
        self._disputes.close()
        if self._changing is not None:
            self._changing.cancel()
        if self._claim is not None:
            self._claim.close()

    # -- an id of one's own --------------------------------------------------------------------------------------

    async def _take_fixed(self, agent_id: int) -> _Claim:
        name = str(AgentId(self._type, agent_id))
        if not 1 <= agent_id <= 0xFFFF:
            raise OutOfRange("id", agent_id, 1, 0xFFFF)
        await self._wait_for_stale(name, (self._type, agent_id))
        if (self._type, agent_id) in self._presence.directory:
            raise UsageError(f"{name} is already online; choose another id, or leave it out")
        claim = await self._settle(agent_id)
        if claim is None:
            raise UsageError(f"{name} was taken by somebody else in this moment; choose another id")
        return claim

    async def _wait_for_stale(self, name: str, key: tuple[int, int]) -> None:
        """Give the token of an earlier life of this agent the time of a lease to end."""
        directory = self._presence.directory
        if key not in directory:
            return
        log.info("%s is still online; waiting for it to go", name)
        deadline = stale_until(self._mesh.settings)
        while key in directory and time.monotonic() < deadline:
            with suppress(asyncio.TimeoutError):
                await within(self._presence.change(), deadline - time.monotonic())

    async def _lease(self) -> _Claim:
        tried: set[int] = set()
        while True:
            taken = tried | set(self._presence.directory.ids(self._type))
            held: set[int] = set()
            if type_name(self._type) != "ros":
                leases = [LEASE.parse(key) for key in await self._mesh.tokens(LEASE.every())]
                held = {lease.block for lease in leases if lease}
            agent_id = free_id(taken, held)
            if agent_id is None:
                raise Unreachable("a free id", f"all ids of type {type_name(self._type)} are taken")
            if (claim := await self._settle(agent_id)) is not None:
                return claim
            tried.add(agent_id)

    async def _settle(self, agent_id: int) -> _Claim | None:
        """Declare presence under an id and see that nobody with an older right to it did the same at once.

        The inbox comes before the token: whoever sees the agent can reach it.
        """
        messages = self._listen(agent_id)
        claim = _Claim(agent_id, (self._presence.declare(self._type, agent_id, self._group), messages))
        claimants = self._presence.directory.claimants
        kept = False
        try:
            kept = await settle(self._mesh.zid, lambda: [agent.zid for agent in claimants(self._type, agent_id)])
        finally:
            if not kept:
                claim.close()
        return claim if kept else None

    # -- an id that others have as well --------------------------------------------------------------------------

    def contested(self, contested: Contested) -> None:
        """What others claim of what this session holds."""
        if self._claim is None:
            return
        key = (self._type, self._claim.id)
        self._disputes.look({key: contested[key]} if key in contested else {})

    def _judged(self, verdicts: list[Verdict[tuple[int, int]]]) -> None:
        for verdict in verdicts:
            others = " and ".join(verdict.others)
            if not verdict.give_way:
                log.error("%s is also held by session %s: change the id that one of them is given", self, others)
            elif self._changing is None:
                self._changing = asyncio.get_running_loop().create_task(self._change(others))

    async def _change(self, others: str) -> None:
        """Take another id; the old one is given up when the new one is settled."""
        old = self._claim
        assert old is not None
        while True:
            try:
                new = await self._lease()
                break
            except MacsError as error:
                log.error("%s is also held by session %s, and there is no other id: %s", self, others, error)
            except Exception:
                log.exception("%s is also held by session %s, and looking for another id failed", self, others)
            await asyncio.sleep(AGAIN_S)
        log.warning("%s is also held by session %s; from now on this is id %d", self, others, new.id)
        self._claim = new
        self._changing = None
        try:
            self._on_id(old.id, new.id)
        except Exception:
            log.exception("handling the new id of %s failed", self)  # whoever listens; the id is changed
        finally:
            old.close()
        self.contested(self._presence.contested())
