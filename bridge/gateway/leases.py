"""The blocks of agent ids that this gateway hands out: leased from the mesh one at a time, more when they run low.

Two parts of a mesh that could not see each other may have leased the same block. When they meet, one of the gateways
gives it up (`macs_zenoh.blocks.Contests`), unless it was configured.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Collection

from macs_zenoh import blocks
from macs_zenoh.blocks import Contests
from macs_zenoh.errors import ConfigError, Unreachable
from macs_zenoh.keyexpr import BLOCK_SIZE, LEASE
from macs_zenoh.mesh import Mesh, Subscription, Token

log = logging.getLogger("macs.gateway")

SETTLE_S = 0.3
"""How long a claimed block waits for somebody else's claim on it to show up."""

LOW = 64
"""With fewer free ids than this, another block is leased ahead of need."""


class Leases:
    """This gateway's blocks. ``wanted`` is the configured first one, None for whatever is free; ``only`` are those
    that it may have, empty for any. What is configured in either way is not given up to another gateway."""

    def __init__(
        self,
        mesh: Mesh,
        wanted: int | None,
        only: Collection[int] = (),
        *,
        on_block: Callable[[int], None],
        on_ids: Callable[[], None],
        on_lost: Callable[[int], None],
    ) -> None:
        """``on_block`` is called for each block that is ours, before ``on_ids``: ids may be given out now; ``on_lost``
        for each that is not any more."""
        self.blocks: list[int] = []
        self._mesh = mesh
        self._wanted = wanted
        self._closed_to_us = frozenset(range(blocks.BLOCKS)) - frozenset(only) if only else frozenset()
        self._on_block = on_block
        self._on_ids = on_ids
        self._on_lost = on_lost
        self._tokens: dict[int, Token] = {}
        self._holders: dict[int, set[str]] = {}
        self._contests: Contests[int] = Contests(mesh.zid, lambda block: block == wanted or block in only)
        self._watching: Subscription | None = None
        self._judging: asyncio.TimerHandle | None = None
        self._taking: asyncio.Task[None] | None = None

    async def take(self) -> None:
        """Lease one more block.

        Raises ConfigError when the configured one is another gateway's, Unreachable when all are leased.
        """
        wanted = self._wanted if not self._tokens else None
        patience_ends = time.monotonic() + self._mesh.settings.lease_ms / 1000 + 1.0
        while True:
            held = await self._held()
            if self._watching is None:  # not before: while a watcher's first news are on their way, answers miss some
                self._watching = self._mesh.watch_tokens(LEASE.every(), self._token)
            block = wanted if wanted is not None else blocks.free_block(held.keys() | self._closed_to_us)
            if block is None and self._closed_to_us and not self.blocks and time.monotonic() < patience_ends:
                await asyncio.sleep(SETTLE_S)  # the lease of an earlier life of this gateway is about to end
                continue
            if block is None:
                raise Unreachable("a free block of ids", "all that this gateway may have are leased")
            if block in held:
                problem = f"block {block} is another gateway's; leave it out to take a free one"
                raise ConfigError("gateway.block", problem)
            token = self._mesh.declare_token(LEASE.of(block=block, zid=self._mesh.zid))
            await asyncio.sleep(SETTLE_S)
            if blocks.keeps(self._mesh.zid, (await self._held()).get(block, [])):
                self._tokens[block] = token
                self.blocks.append(block)
                self._on_block(block)
                log.info("giving out agent ids %d..%d", max(1, block * BLOCK_SIZE), (block + 1) * BLOCK_SIZE - 1)
                self._look()
                return
            token.close()

    def free_id(self, taken: Collection[int]) -> int | None:
        """The lowest free id of our blocks; leases ahead when few are left."""
        room = len(self.blocks) * BLOCK_SIZE - sum(1 for agent_id in taken if agent_id // BLOCK_SIZE in self.blocks)
        if room < LOW:
            self._start_taking()
        for block in self.blocks:
            if (agent_id := blocks.free_id_in(block, taken)) is not None:
                return agent_id
        return None

    def has_lease(self, zid: str) -> bool:
        """Whether a session is a gateway's."""
        return any(zid in holders for holders in self._holders.values())

    async def more(self) -> None:
        """Wait for one more block, or for the end of a vain attempt to have one."""
        await asyncio.shield(self._start_taking())

    def close(self) -> None:
        """Give the blocks back."""
        for going_on in (self._taking, self._judging):
            if going_on is not None:
                going_on.cancel()
        if self._watching is not None:
            self._watching.close()
        for token in self._tokens.values():
            token.close()

    # -- a block that others have as well ------------------------------------------------------------------------

    def _token(self, key: str, alive: bool) -> None:
        if (lease := LEASE.parse(key)) is not None:
            holders = self._holders.setdefault(int(lease["block"]), set())
            (holders.add if alive else holders.discard)(str(lease["zid"]))
            self._look()

    def _look(self) -> None:
        if self._judging is not None:
            self._judging.cancel()
            self._judging = None
        now = time.monotonic()
        self._contests.look({block: self._holders.get(block, set()) - {self._mesh.zid} for block in self.blocks}, now)
        for block, others, give_way in self._contests.judge(now):
            by = f"session {' and '.join(others)}"
            if give_way:
                log.warning("block %d is also leased by %s, which keeps it", block, by)
                self.blocks.remove(block)
                self._tokens.pop(block).close()
                self._on_lost(block)
            else:
                log.error("block %d is also leased by %s: change gateway.block of one of the two", block, by)
        if (deadline := self._contests.next_deadline()) is not None:
            delay_s = max(0.0, deadline - now) + 0.01
            self._judging = asyncio.get_running_loop().call_later(delay_s, self._look)

    # -- taking --------------------------------------------------------------------------------------------------

    def _start_taking(self) -> asyncio.Task[None]:
        if self._taking is None:
            self._taking = asyncio.get_running_loop().create_task(self._take_ahead())
        return self._taking

    async def _take_ahead(self) -> None:
        try:
            await self.take()
        except Unreachable as error:
            log.warning("no more ids: %s", error)
            await asyncio.sleep(10.0)
        finally:
            self._taking = None
        self._on_ids()

    async def _held(self) -> dict[int, list[str]]:
        """Every leased block and the Zenoh ids of its holders."""
        held: dict[int, list[str]] = {}
        for key in await self._mesh.tokens(LEASE.every()):
            if lease := LEASE.parse(key):
                held.setdefault(int(lease["block"]), []).append(str(lease["zid"]))
        return held
