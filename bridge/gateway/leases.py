"""The blocks of agent ids that this gateway hands out: leased from the mesh one at a time, more when they run low."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection

from macs_zenoh import blocks
from macs_zenoh.errors import ConfigError, Unreachable
from macs_zenoh.keyexpr import BLOCK_SIZE, LEASE
from macs_zenoh.mesh import Mesh, Token

log = logging.getLogger("macs.gateway")

SETTLE_S = 0.3
"""How long a claimed block waits for somebody else's claim on it to show up."""

LOW = 64
"""With fewer free ids than this, another block is leased ahead of need."""


class Leases:
    """This gateway's blocks. ``wanted`` is the configured first one, None for whatever is free."""

    def __init__(
        self, mesh: Mesh, wanted: int | None, on_block: Callable[[int], None], on_ids: Callable[[], None]
    ) -> None:
        """``on_block`` is called for each block that is ours, before ``on_ids``: ids may be given out now."""
        self.blocks: list[int] = []
        self._mesh = mesh
        self._wanted = wanted
        self._on_block = on_block
        self._on_ids = on_ids
        self._tokens: list[Token] = []
        self._taking: asyncio.Task[None] | None = None

    async def take(self) -> None:
        """Lease one more block.

        Raises ConfigError when the configured one is another gateway's, Unreachable when all are leased.
        """
        wanted = self._wanted if not self.blocks else None
        while True:
            held = await self._held()
            block = wanted if wanted is not None else blocks.free_block(held.keys())
            if block is None:
                raise Unreachable("a free block of ids", "all 256 are leased")
            if block in held:
                problem = f"block {block} is another gateway's; leave it out to take a free one"
                raise ConfigError("gateway.block", problem)
            token = self._mesh.declare_token(LEASE.of(block=block, zid=self._mesh.zid))
            await asyncio.sleep(SETTLE_S)
            if blocks.keeps(self._mesh.zid, (await self._held()).get(block, [])):
                self._tokens.append(token)
                self.blocks.append(block)
                self._on_block(block)
                log.info("giving out agent ids %d..%d", max(1, block * BLOCK_SIZE), (block + 1) * BLOCK_SIZE - 1)
                return
            token.close()

    def free_id(self, taken: Collection[int]) -> int | None:
        """The lowest free id of our blocks; leases ahead when few are left."""
        room = len(self.blocks) * BLOCK_SIZE - sum(1 for agent_id in taken if agent_id // BLOCK_SIZE in self.blocks)
        if room < LOW and self._taking is None:
            self._taking = asyncio.get_running_loop().create_task(self._take_ahead())
        for block in self.blocks:
            if (agent_id := blocks.free_id_in(block, taken)) is not None:
                return agent_id
        return None

    def close(self) -> None:
        """Give the blocks back."""
        if self._taking is not None:
            self._taking.cancel()
        for token in self._tokens:
            token.close()

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
