"""Ids and blocks are handed out from the lowest, each to one holder."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.blocks import BLOCKS, free_block, free_id, free_id_in, keeps
from macs_zenoh.keyexpr import BLOCK_SIZE, block_of

zids = st.text("0123456789abcdef", min_size=1, max_size=4)


@given(st.sets(st.integers(0, BLOCKS - 1)))
def test_the_lowest_free_block_is_taken(taken: set[int]) -> None:
    """The block given is free and all below it are not."""
    block = free_block(taken)
    assert block is not None
    assert block not in taken
    assert taken >= set(range(block))


def test_there_are_256_blocks() -> None:
    """When every block is leased there is none to give; one of them freed is given again."""
    everything = set(range(BLOCKS))
    assert free_block(everything) is None
    assert free_block(everything - {77}) == 77


@given(st.integers(0, BLOCKS - 1), st.sets(st.integers(0, 0xFFFF)))
def test_the_lowest_free_id_of_a_block_is_taken(block: int, taken: set[int]) -> None:
    """The id given belongs to the block, is free, is not 0, and all below it in the block are taken."""
    agent_id = free_id_in(block, taken)
    assert agent_id is not None
    assert agent_id > 0
    assert block_of(agent_id) == block
    assert agent_id not in taken
    assert taken | {0} >= set(range(block * BLOCK_SIZE, agent_id))


def test_a_block_has_256_ids_and_the_first_255() -> None:
    """Block 0 starts at id 1, every other block at its first id; a full block gives None."""
    assert [free_id_in(0, range(1, n)) for n in (1, 2, 255, 256)] == [1, 2, 255, None]
    assert [free_id_in(255, range(0xFF00, n)) for n in (0xFF00, 0xFFFF, 0x10000)] == [0xFF00, 0xFFFF, None]


@given(st.sets(st.integers(1, 2000)), st.sets(st.integers(0, 7), max_size=8))
def test_the_lowest_id_outside_leased_blocks_is_taken(taken: set[int], leased: set[int]) -> None:
    """An id that an agent chooses for itself is free, in nobody's block, and the lowest such id."""
    agent_id = free_id(taken, leased)
    assert agent_id is not None
    assert agent_id > 0
    assert agent_id not in taken
    assert block_of(agent_id) not in leased
    assert all(lower in taken or block_of(lower) in leased for lower in range(1, agent_id))


def test_ids_run_out() -> None:
    """When all ids are taken or inside leased blocks there is none to give."""
    assert free_id(range(1, 0x10000)) is None
    assert free_id((), range(BLOCKS)) is None
    assert free_id(range(1, 0xFFFF)) == 0xFFFF


@given(st.sets(zids, min_size=1))
def test_exactly_one_of_all_claimants_keeps(claimants: set[str]) -> None:
    """When several claim the same at once and all see all claims, one keeps it and it is the smallest."""
    assert [zid for zid in claimants if keeps(zid, claimants)] == [min(claimants)]


def test_who_is_alone_keeps() -> None:
    """A holder whose claim is the only one, or not yet to be seen, keeps what it holds."""
    assert keeps("a1", ["a1"])
    assert keeps("a1", [])
