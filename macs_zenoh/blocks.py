"""Who hands out which ids. Pure: who else holds what comes in, a choice goes out.

A gateway leases a *block*, 256 ids with the same high byte, and gives them to the agents that connect to it, from 1
up, as they are used to. A lease is a liveliness token that carries the holder's Zenoh id; when two choose the same
thing at once, the smaller Zenoh id keeps it and the other chooses again. The same rule settles single ids.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from .keyexpr import BLOCK_SIZE, block_of

BLOCKS = 256
"""Blocks on one mesh: ids are 16 bits."""


def free_block(taken: Collection[int]) -> int | None:
    """The lowest block that nobody holds; None when all 256 are taken."""
    return next((block for block in range(BLOCKS) if block not in taken), None)


def keeps(mine: str, claimants: Iterable[str]) -> bool:
    """Whether the holder with Zenoh id ``mine`` keeps what all ``claimants`` hold a token for."""
    return all(mine <= other for other in claimants)


def free_id_in(block: int, taken: Collection[int]) -> int | None:
    """The lowest id of a block that is not taken; None when the block is full. Id 0 is no id."""
    first = block * BLOCK_SIZE
    return next((i for i in range(max(1, first), first + BLOCK_SIZE) if i not in taken), None)


def free_id(taken: Collection[int], leased_blocks: Collection[int] = ()) -> int | None:
    """The lowest id that is neither taken nor inside somebody's block."""
    return next((i for i in range(1, 0x10000) if i not in taken and block_of(i) not in leased_blocks), None)
