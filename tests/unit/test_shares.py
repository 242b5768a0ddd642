"""Whose turn it is to be read from: one of those that take much in each round, and by address."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable

import pytest

from bridge.gateway import shares
from bridge.gateway.shares import LATEST_S, SHARE, TURN_S, Rounds, Share
from macs_zenoh.protocol.ping import PING_BYTES_PER_S, PINGS_PER_S, PingGate
from macs_zenoh.protocol.rate_limit import FLOODED, NOW, Pace


def test_a_share_is_used_up_by_what_is_beyond_it() -> None:
    """Little now and then never is; as much at once is, and then another turn begins."""
    share = Share()
    assert not any(share.spend(TURN_S * SHARE / 2, now * TURN_S) for now in range(1000))
    assert not share.spend(TURN_S * 0.9, 5.0)
    assert share.spend(TURN_S * 0.2, 5.0)
    assert not share.spend(TURN_S * 0.9, 5.0)


async def test_many_of_one_address_use_up_its_share_together() -> None:
    """Each takes less than a turn, and would for itself never wait."""
    clock = [100.0]
    rounds = Rounds(lambda: clock[0])
    waits = []
    for _ in range(500):
        clock[0] += TURN_S / 4
        waits.append(rounds.spend("10.0.0.1", Share(), TURN_S / 4))
    assert sum(wait > 0 for wait in waits) == pytest.approx(100, abs=3)
    assert max(waits) == pytest.approx(TURN_S / 4)
    assert not rounds.spend("10.0.0.2", Share(), TURN_S / 4)


def test_what_passes_while_the_thread_waits_is_nobodys() -> None:
    """On a busy machine the least work takes long, and would use up a turn each time."""
    clock = [100.0]
    rounds, share = Rounds(lambda: clock[0]), Share()
    for _ in range(50):
        clock[0] += TURN_S / 1000
        assert not rounds.spend("10.0.0.1", share, 10 * TURN_S)


def test_little_work_is_counted_and_seldom_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who does little a thousand times waits as often as if each was timed, and a clock is looked at for few."""
    clock, looks = [100.0], [0]

    def look() -> float:
        looks[0] += 1
        return clock[0]

    def waits() -> int:
        rounds, share, little_s, count = Rounds(look), Share(), TURN_S / 100, 0
        for _ in range(1000):
            clock[0] += little_s
            count += rounds.spend("10.0.0.1", share, little_s) > 0
        return count

    seldom = waits()
    assert looks[0] < 100
    monkeypatch.setattr(shares, "LITTLE_S", 0.0)
    assert waits() == pytest.approx(seldom, abs=1)
    assert looks[0] > 1000


async def went_on(entered: list[tuple[str, float]]) -> list[tuple[str, int]]:
    """The address of each that went on and in which round of the loop, of these addresses and turns."""
    rounds, loop, went, passed = Rounds(), asyncio.get_running_loop(), list[tuple[str, int]](), [0]

    def tick() -> None:
        passed[0] += 1
        if len(went) < len(entered):
            loop.call_soon(tick)

    def goes(host: str) -> Callable[[], None]:
        return lambda: went.append((host, passed[0]))

    tick()
    for host, turn_s in entered:
        rounds.enter(host, None, goes(host), turn_s)
    while len(went) < len(entered):
        await asyncio.sleep(0)
    return went


async def test_one_goes_on_in_each_round_and_addresses_take_turns() -> None:
    """However many wait from one address: another one waits for one of them."""
    went = await went_on([*[("10.0.0.1", TURN_S)] * 20, ("10.0.0.2", TURN_S)])
    assert [host for host, _ in went[:3]] == ["10.0.0.1", "10.0.0.2", "10.0.0.1"]
    assert len({round_of_loop for _, round_of_loop in went}) == 21


async def test_of_short_turns_several_are_in_one_round() -> None:
    """Or those of one address that each do little would wait for each other."""
    went = await went_on([("10.0.0.1", 0.3 * TURN_S)] * 10)
    in_round = Counter(round_of_loop for _, round_of_loop in went)
    assert sorted(in_round.values()) == [2, 4, 4]


async def test_who_is_cancelled_while_he_waits_holds_up_nobody() -> None:
    """His turn passes."""
    rounds = Rounds()
    first, second = (asyncio.create_task(rounds.turn("10.0.0.1", None)) for _ in range(2))
    await asyncio.sleep(0)
    first.cancel()
    await asyncio.wait_for(second, 10)


def test_pings_beyond_a_rate_are_not_answered() -> None:
    """Neither more of them, nor more bytes; it is counted, and passes."""
    dropped = []
    gate = PingGate(0.0, lambda: dropped.append(1))
    assert sum(gate.admits("macs/ping/x", 0, False, 0.0) for _ in range(5 * PINGS_PER_S)) == PINGS_PER_S
    assert len(dropped) == 4 * PINGS_PER_S
    assert gate.admits("macs/ping/x", PING_BYTES_PER_S, False, 10.0)
    assert not gate.admits("macs/ping/x", PING_BYTES_PER_S // 2, False, 10.1)
    assert gate.admits("macs/ping/x", 1 << 20, False, 20.0)


def test_who_comes_back_has_what_he_had_left() -> None:
    """Or whoever comes back again and again could send as much as goes."""
    before, after = Pace(100, 100, 0.0), Pace(100, 100, 0.0)
    assert before.request(100, 0.0) is NOW
    assert before.command("x", 100, 0.0) is NOW
    after.has_left(before)
    assert after.request(1, 0.0) is FLOODED
    assert after.command("x", 1, 0.0) is FLOODED


async def test_of_many_that_take_much_together_no_more_is_done_in_a_round_than_a_turn() -> None:
    """Each takes little: others would wait for all of them. Whoever is not one of them never waits."""
    clock = [100.0]
    rounds, each_s = Rounds(lambda: clock[0]), TURN_S / 10

    def work(host: str) -> bool:
        if rounds.are_over(host):
            return False
        clock[0] += each_s
        rounds.spend(host, Share(), each_s)
        return True

    assert sum(work("10.0.0.1") for _ in range(15)) == 15  # from here on it takes much
    for _ in range(3):
        await asyncio.sleep(0)
        done = [work("10.0.0.1") for _ in range(100)]
        assert sum(done) == pytest.approx(11, abs=1)
        assert work("10.0.0.2")


async def test_what_goes_on_in_its_turn_counts_in_its_round() -> None:
    """Or as much again would be done beside it."""
    clock, went = [100.0], list[bool]()
    rounds = Rounds(lambda: clock[0])
    while not rounds.are_over("10.0.0.1"):
        clock[0] += TURN_S / 2
        rounds.spend("10.0.0.1", Share(), TURN_S / 2)

    def goes_on() -> None:
        clock[0] += 2 * TURN_S
        rounds.spend("10.0.0.1", Share(), 2 * TURN_S)

    rounds.enter("10.0.0.1", None, goes_on)
    for _ in range(2):  # in the same round, and in the next one
        asyncio.get_running_loop().call_soon(lambda: went.append(rounds.are_over("10.0.0.1")))
        await asyncio.sleep(0)
    assert went == [True, False]


async def test_a_round_is_long_that_has_had_much_work_whoever_it_was_for() -> None:
    """Each of them may have his turn, and nobody knows yet that he takes much; the next round is another one."""
    clock = [100.0]
    rounds = Rounds(lambda: clock[0])
    assert not rounds.long
    for number in range(3):
        assert not rounds.long
        clock[0] += TURN_S
        assert not rounds.spend(f"10.0.0.{number}", Share(), 0.9 * TURN_S)
    assert rounds.long
    await asyncio.sleep(0)
    assert not rounds.long


async def test_what_is_handed_over_counts_while_any_address_takes_much() -> None:
    """What is done for whoever it may be is of the same round: so much less of those that take much."""
    clock = [100.0]
    rounds = Rounds(lambda: clock[0])
    rounds.add(TURN_S)
    while not rounds.are_over("10.0.0.1"):
        clock[0] += TURN_S
        rounds.spend("10.0.0.1", Share(), TURN_S)
    await asyncio.sleep(0)
    assert not rounds.are_over("10.0.0.1")
    rounds.add(2 * TURN_S)
    assert rounds.are_over("10.0.0.1")
    assert not rounds.are_over("10.0.0.2")


async def test_of_one_address_who_has_had_little_comes_first() -> None:
    """A stop waits for none of twenty that have had much, nor the twenty for each other longer than before."""
    clock, went = [100.0], list[str]()
    rounds, many, one = Rounds(lambda: clock[0]), [Share() for _ in range(20)], Share()
    for share in many:
        clock[0] += 10 * TURN_S
        rounds.spend("10.0.0.1", share, 10 * TURN_S)
    clock[0] += TURN_S / 50
    rounds.spend("10.0.0.1", one, TURN_S / 50)
    for number, share in enumerate(many):
        rounds.enter("10.0.0.1", share, lambda number=number: went.append(f"{number}"))  # type: ignore[misc]
    rounds.enter("10.0.0.1", one, lambda: went.append("stop"))
    while len(went) < 21:
        await asyncio.sleep(0)
    assert went[0] == "stop"
    assert sorted(map(int, went[1:])) == list(range(20))


async def test_who_has_had_much_waits_for_others_no_longer_than_a_second() -> None:
    """However many come who have had nothing yet."""
    clock, went = [100.0], list[float]()
    rounds, much = Rounds(lambda: clock[0]), Share()
    clock[0] += 1.0
    rounds.spend("10.0.0.1", much, 1.0)
    rounds.enter("10.0.0.1", much, lambda: went.append(clock[0]))

    def another() -> None:
        clock[0] += TURN_S
        share = Share()
        rounds.spend("10.0.0.1", share, TURN_S)
        if not went:
            rounds.enter("10.0.0.1", Share(), another)

    for _ in range(5):
        rounds.enter("10.0.0.1", Share(), another)
    while not went:
        assert clock[0] < 101.0 + LATEST_S + 10 * TURN_S
        await asyncio.sleep(0)
    assert went[0] == pytest.approx(101.0 + LATEST_S, abs=10 * TURN_S)
