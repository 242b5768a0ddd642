"""The blocks of agent ids that this gateway hands out: leased from the mesh, more of them before they run out.

Two parts of a mesh that could not see each other may have leased the same block. When they meet, one of the gateways
gives it up (`macs_zenoh.protocol.ids.Contests`), unless it was configured.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Collection, Iterable, Sequence

from macs_zenoh.anew import Anew
from macs_zenoh.claims import SETTLE_S, Disputes, stale_until
from macs_zenoh.errors import ConfigError, Unreachable
from macs_zenoh.mesh import Mesh, Subscription, Token
from macs_zenoh.protocol import ids as blocks
from macs_zenoh.protocol.ids import Contests, FreeIds, Verdict
from macs_zenoh.protocol.keyexpr import BLOCK_SIZE, LEASE
from macs_zenoh.protocol.room import Room

log = logging.getLogger("macs.gateway")

LOW = 128
"""With fewer free ids than this, another block is leased ahead of need."""

AT_ONCE = 16
"""How many blocks are leased together when many wait for ids."""

TRUTH_S = 2.0
"""How long answers are not believed that leave out what we hold ourselves: a busy router may answer nothing."""

HOLDERS = 16
"""Sessions that lease the same block, as far as they count: where parts of a mesh meet there are two."""

AGAIN_S = 2.0
"""Pause after an attempt in vain to lease a block."""


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
        self._free = FreeIds()
        self._wanting = 0
        self._tokens: dict[int, Token] = {}
        self._claims: dict[int, Token] = {}
        self.exhausted = False
        """Whether the last attempt found that all blocks are leased."""
        self._holders: dict[int, set[str]] = {}
        self._room: Room[int] = Room(mesh.zid, sessions=HOLDERS, each=blocks.BLOCKS, total=2 * HOLDERS * blocks.BLOCKS)
        self._anew = Anew(mesh, [LEASE.every()], self._again)
        self._disputes = Disputes(
            Contests[int](mesh.zid, lambda block: block == wanted or block in only), self._judged
        )
        self._watching: Subscription | None = None
        self._taking: asyncio.Task[None] | None = None

    async def take(self, count: int = 1) -> None:
        """Lease blocks: ``count``, or as many of them as can be had, at least one.

        Raises ConfigError when the configured one is another gateway's, Unreachable when all are leased.
        """
        wanted = self._wanted if not self._tokens else None
        patience_ends = stale_until(self._mesh.settings)
        while True:
            held = await self._held()
            if self._watching is None:  # not before: while a watcher's first news are on their way, answers miss some
                self._watching = self._mesh.watch_tokens(LEASE.every(), self._token)
            if wanted in held:
                problem = f"block {wanted} is another gateway's; leave it out to take a free one"
                raise ConfigError("gateway.block", problem)
            chosen = [wanted] if wanted is not None else blocks.free_blocks(held.keys() | self._closed_to_us, count)
            if not chosen and self._closed_to_us and not self.blocks and time.monotonic() < patience_ends:
                await asyncio.sleep(SETTLE_S)  # the lease of an earlier life of this gateway is about to end
                continue
            if not chosen:
                raise Unreachable("a free block of ids", "all that this gateway may have are leased")
            if await self._claim(chosen):
                return

    async def _claim(self, chosen: Iterable[int]) -> bool:
        """Lease these blocks, except those that somebody with an older right to them claims as well; whether we got
        any."""
        self._claims = {block: self._mesh.declare_token(LEASE.of(block=block, zid=self._mesh.zid)) for block in chosen}
        try:
            await asyncio.sleep(SETTLE_S)
            held = await self._held()
            ours = [block for block in self._claims if blocks.keeps(self._mesh.zid, held.get(block, ()))]
            for block in ours:
                self._tokens[block] = self._claims.pop(block)
                self.blocks.append(block)
                self._free.add_block(block)
                self._on_block(block)
                log.info("giving out agent ids %d..%d", max(1, block * BLOCK_SIZE), (block + 1) * BLOCK_SIZE - 1)
            self._look()
            return bool(ours)
        finally:
            claims, self._claims = self._claims, {}
            for token in claims.values():
                token.close()

    def take_id(self, is_elsewhere: Callable[[int], bool], wanting: int = 1) -> int | None:
        """A free id of our blocks that nobody else has; None when there is none now. ``wanting`` is how many are
        wanted in all: enough blocks are leased for them, ahead of need."""
        agent_id = self._free.take(is_elsewhere)
        self._wanting = wanting - (agent_id is not None)
        if len(self._free) < self._wanting + LOW:
            self._start_taking()
        return agent_id

    def give_back(self, agent_id: int) -> None:
        """Nobody has this id any more."""
        self._free.give_back(agent_id)

    def has_lease(self, zid: str) -> bool:
        """Whether a session is a gateway's."""
        return any(zid in holders for holders in self._holders.values())

    async def more(self) -> None:
        """Wait for one more block, or for the end of a vain attempt to have one."""
        await asyncio.shield(self._start_taking())

    def close(self) -> None:
        """Give the blocks back."""
        self._disputes.close()
        self._anew.close()
        if self._taking is not None:
            self._taking.cancel()
        if self._watching is not None:
            self._watching.close()
        for token in [*self._tokens.values(), *self._claims.values()]:
            token.close()

    # -- a block that others have as well ------------------------------------------------------------------------

    def _token(self, key: str, alive: bool) -> None:
        if not alive:
            self._anew.ended(key)
        if (lease := LEASE.parse(key)) is not None:
            self._note(lease.block, lease.zid, alive)
            self._look()

    def _again(self, keys: Sequence[str]) -> None:
        for key in keys:
            if (lease := LEASE.parse(key)) is not None:
                self._note(lease.block, lease.zid, True)
        self._look()

    def _note(self, block: int, zid: str, alive: bool) -> None:
        holders = self._holders.setdefault(block, set())
        if not alive and zid in holders:
            holders.discard(zid)
            self._room.release(block, zid)
        elif alive and zid not in holders:
            out = self._room.take(block, zid, holders)
            if out is not None:
                text = "more than %d sessions lease block %d: some do not count"
                self._mesh.drops.once("too_many_claims", text, HOLDERS, block, about="blocks")
            holders.add(zid)
            holders.discard(out or "")
        if self._room.is_made():
            self._anew.ask()

    def _look(self) -> None:
        self._disputes.look({block: self._holders.get(block, set()) - {self._mesh.zid} for block in self.blocks})

    def _judged(self, verdicts: list[Verdict[int]]) -> None:
        for verdict in verdicts:
            block, by = verdict.what, f"session {' and '.join(verdict.others)}"
            if verdict.give_way:
                log.warning("block %d is also leased by %s, which keeps it", block, by)
                self.blocks.remove(block)
                self._free.remove_block(block)
                self._tokens.pop(block).close()
                self._on_lost(block)
            else:
                log.error("block %d is also leased by %s: change gateway.block of one of the two", block, by)

    # -- taking --------------------------------------------------------------------------------------------------

    def _start_taking(self) -> asyncio.Task[None]:
        if self._taking is None:
            told, self.exhausted = self.exhausted, False  # who waits is told what this attempt finds, not the last one
            self._taking = asyncio.get_running_loop().create_task(self._take_ahead(told))
        return self._taking

    async def _take_ahead(self, told: bool) -> None:
        missing = self._wanting + LOW - len(self._free)
        try:
            await self.take(min(AT_ONCE, 1 + missing // BLOCK_SIZE))
        except Unreachable as error:
            if not told:
                log.warning("no more ids: %s", error)
            self.exhausted = True
        except Exception:  # whatever it was, who waits for an id must not wait for ever
            log.exception("leasing a block of ids failed; trying again")
        if self.exhausted:
            self._on_ids()  # who waits can be told
            await asyncio.sleep(AGAIN_S)
        self._taking = None
        self._on_ids()

    async def _held(self) -> dict[int, set[str]]:
        """Every leased block and the Zenoh ids of its holders: what routers answer, what we have been told, and what
        we hold ourselves. An answer that leaves ours out is asked for again."""
        deadline = time.monotonic() + TRUTH_S
        ours = self._tokens.keys() | self._claims.keys()
        while True:
            held = {block: {self._mesh.zid} for block in ours}
            told = {block: zids for block, zids in self._holders.items() if zids}
            answered = _by_block(await self._mesh.tokens(LEASE.every()))
            for known in (answered, told):
                for block, zids in known.items():
                    held.setdefault(block, set()).update(zids)
            missing = [block for block in ours if self._mesh.zid not in answered.get(block, ())]
            if not missing or time.monotonic() > deadline:
                return held
            log.debug("the routers' answer leaves out our own blocks %s: asking again", missing)
            await asyncio.sleep(0.05)


def _by_block(keys: Iterable[str]) -> dict[int, set[str]]:
    holders: dict[int, set[str]] = {}
    for lease in map(LEASE.parse, keys):
        if lease is not None:
            holders.setdefault(lease.block, set()).add(lease.zid)
    return holders
