"""Ids and blocks are handed out from the lowest, each to one holder."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.protocol.ids import (
    BLOCKS,
    COMPLAINT_S,
    GATEWAY_PATIENCE_S,
    PATIENCE_S,
    Contests,
    Epochs,
    FreeIds,
    Verdict,
    free_blocks,
    free_id,
    keeps,
)
from macs_zenoh.protocol.keyexpr import block_of

zids = st.text("0123456789abcdef", min_size=1, max_size=4)


@given(st.lists(st.tuples(st.integers(1, 3), st.integers(1, 4)), min_size=1, max_size=200))
def test_an_id_has_another_epoch_for_whoever_has_it_next(chosen: list[tuple[int, int]]) -> None:
    """Of the same connection the same; of the next another one, and no more of them than there are for each id."""
    epochs, now, seen = Epochs(), dict[int, tuple[int, int]](), dict[int, list[int]]()
    for agent_id, step in chosen:
        before, epoch = now.get(agent_id, (0, 0))
        connection = before + step % 2  # the same one, or the next
        if not connection:
            continue
        found = epochs.of((2, agent_id), connection)
        assert (found == epoch) == (connection == before)
        now[agent_id] = connection, found
        if connection != before:
            seen.setdefault(agent_id, []).append(found)
    for found_all in seen.values():
        assert set(found_all) <= set(range(1, Epochs.MOST + 1))
        for at in range(len(found_all)):
            assert len(set(found_all[at : at + Epochs.MOST])) == len(found_all[at : at + Epochs.MOST])


def test_epochs_of_agents_that_are_long_gone_are_forgotten() -> None:
    """Room is bounded, whatever ids robots choose; of who is there nothing is lost."""
    epochs = Epochs()
    epochs.of((2, 1), 1)
    for number in range(Epochs.AGENTS):
        assert epochs.of((3, number), 5) == 1
    assert epochs.of((2, 1), 2) == 1
    assert epochs.of((3, Epochs.AGENTS - 1), 5) == 1


@given(st.sets(st.integers(0, BLOCKS - 1), max_size=BLOCKS - 1))
def test_the_lowest_free_block_is_taken(taken: set[int]) -> None:
    """The block given is free and all below it are not."""
    (block,) = free_blocks(taken)
    assert block not in taken
    assert taken >= set(range(block))


def test_there_are_256_blocks() -> None:
    """When every block is leased there is none to give; one of them freed is given again."""
    everything = set(range(BLOCKS))
    assert free_blocks(everything) == []
    assert free_blocks(everything - {77, 200, 250}, 2) == [77, 200]


def test_a_block_has_256_ids_and_the_first_255() -> None:
    """Block 0 starts at id 1, every other block at its first id; a full block gives None."""
    for block, first, count in ((0, 1, 255), (1, 256, 256), (255, 0xFF00, 256)):
        ids = FreeIds()
        ids.add_block(block)
        assert len(ids) == count
        assert [ids.take(nobody) for _ in range(count)] == list(range(first, first + count))
        assert ids.take(nobody) is None


def nobody(agent_id: int) -> bool:
    """Nobody else has an id."""
    return False


def test_an_id_is_used_again_last() -> None:
    """Ids that nobody had come first, then the one that is free for the longest."""
    ids = FreeIds()
    ids.add_block(0)
    assert [ids.take(nobody) for _ in range(3)] == [1, 2, 3]
    ids.give_back(2)
    ids.give_back(1)
    assert [ids.take(nobody) for _ in range(252)] == list(range(4, 256))
    assert [ids.take(nobody) for _ in range(3)] == [2, 1, None]


def test_an_id_that_another_has_is_given_when_it_is_free() -> None:
    """What somebody else has is passed over, and looked at again when there is nothing else."""
    ids = FreeIds()
    ids.add_block(0)
    others = set(range(2, 256))
    assert ids.take(others.__contains__) == 1
    assert ids.take(others.__contains__) is None
    others.remove(200)
    looks = -(-len(others) // FreeIds.LOOKS)
    assert 200 in [ids.take(others.__contains__) for _ in range(looks)]


steps = st.lists(
    st.tuples(st.sampled_from(["add", "remove"]), st.integers(0, 3))
    | st.tuples(st.sampled_from(["take", "give"]), st.integers(0, 0x4FF)),
    max_size=60,
)


@given(steps, st.sets(st.integers(0, 0x3FF)))
def test_ids_are_given_once(story: list[tuple[str, int]], others: set[int]) -> None:
    """Whatever happens, an id given belongs to a block of ours, is not 0, and neither ours nor others' already."""
    ids = FreeIds()
    blocks: set[int] = set()
    given_out: set[int] = set()
    for what, value in story:
        if what == "add":
            ids.add_block(value)
            blocks.add(value)
        elif what == "remove":
            ids.remove_block(value)
            blocks.discard(value)
        elif what == "give":
            ids.give_back(value)
            given_out.discard(value)
        elif (agent_id := ids.take(others.__contains__)) is not None:
            assert agent_id > 0
            assert block_of(agent_id) in blocks
            assert agent_id not in given_out | others
            given_out.add(agent_id)


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


# -- what several have -----------------------------------------------------------------------------------------------


def contests(mine: str, *, fixed: bool = False) -> Contests[int]:
    """Contests of a holder all of whose claims are configured, or leased."""
    return Contests(mine, lambda what: fixed)


def test_who_leased_the_same_with_a_greater_session_gives_way_at_once() -> None:
    """Of two that leased the same, the one with the greater Zenoh id gives way at once, and is told so once."""
    greater = contests("b2")
    assert greater.look({7: ["a1"]}, 10.0) == []
    assert greater.next_deadline() == 10.0
    assert greater.judge(10.0) == [Verdict(7, ["a1"], give_way=True)]
    assert greater.judge(99.0) == []
    assert greater.next_deadline() is None


def test_the_rightful_holder_waits_before_it_gives_way() -> None:
    """The smallest Zenoh id keeps what it leased; if the other has not given way in time, it must be configured there
    and is left to it."""
    smaller = contests("a1")
    smaller.look({7: ["b2"]}, 10.0)
    assert smaller.judge(10.0 + PATIENCE_S - 0.01) == []
    assert smaller.judge(10.0 + PATIENCE_S) == [Verdict(7, ["b2"], give_way=True)]
    smaller = contests("a1")
    smaller.look({7: ["b2"]}, 10.0)
    assert smaller.look({}, 10.3) == [7]
    assert smaller.next_deadline() is None
    assert smaller.judge(99.0) == []


def test_gateways_get_the_time_they_need() -> None:
    """For ids that another gateway has to give up, the rightful holder waits as long as hundreds may take."""
    holder: Contests[int] = Contests("a1", lambda what: False, {"b2"}.__contains__)
    holder.look({7: ["b2"], 8: ["c3"]}, 10.0)
    assert holder.judge(10.0 + PATIENCE_S) == [Verdict(8, ["c3"], give_way=True)]
    assert holder.next_deadline() == 10.0 + GATEWAY_PATIENCE_S


def test_what_is_configured_is_never_given_up() -> None:
    """A configured holder, whatever its Zenoh id, complains once, naming the others, when nobody can give way any
    more; never before those who leased it had their time."""
    assert COMPLAINT_S > PATIENCE_S
    for mine, other in (("a1", "b2"), ("b2", "a1")):
        holder = contests(mine, fixed=True)
        holder.look({7: [other]}, 10.0)
        assert holder.judge(10.0 + COMPLAINT_S - 0.01) == []
        assert holder.judge(10.0 + COMPLAINT_S) == [Verdict(7, [other], give_way=False)]
        holder.look({7: [other]}, 20.0)
        assert holder.judge(99.0) == []


def test_a_contest_begins_anew_with_somebody_else() -> None:
    """Fewer others are the same contest; another one is a new one; the end of a contest is told."""
    holder = contests("a1", fixed=True)
    holder.look({7: ["b2", "c3"]}, 10.0)
    holder.look({7: ["c3"]}, 12.0)
    assert holder.next_deadline() == 10.0 + COMPLAINT_S
    holder.look({7: ["c3", "d4"]}, 12.5)
    assert holder.next_deadline() == 12.5 + COMPLAINT_S
    assert 7 in holder
    assert holder.look({}, 13.0) == [7]
    assert 7 not in holder


@given(st.dictionaries(zids, st.booleans(), min_size=2, max_size=6))
def test_one_is_left_of_all_who_leased_the_same(holders: dict[str, bool]) -> None:
    """However many hold the same, when all see each other and do what they are told, those who leased it are gone if
    one is configured, and exactly one is left if none is."""
    everybody = {zid: contests(zid, fixed=fixed) for zid, fixed in holders.items()}
    left = set(everybody)
    for now in (0.0, 0.3, PATIENCE_S, PATIENCE_S + 0.3, COMPLAINT_S):
        for zid in left:
            everybody[zid].look({7: sorted(left - {zid})}, now)
        left -= {zid for zid in left for verdict in everybody[zid].judge(now) if verdict.give_way}
    configured = {zid for zid, fixed in holders.items() if fixed}
    assert left == (configured or {min(holders)})
