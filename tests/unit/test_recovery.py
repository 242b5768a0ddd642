"""Gaps of reliable sources: found, asked for, closed in order; against sources and links that fail in every way."""

from __future__ import annotations

import itertools
import random
from collections import deque

import pytest

from macs_zenoh.protocol import recovery
from macs_zenoh.protocol.recovery import (
    ATTEMPTS,
    AWAY_S,
    NUMBERS,
    OVERTAKEN_S,
    PIECE,
    PIECE_BYTES,
    SILENT_S,
    Ask,
    Recovery,
    Sample,
)

KEY = "macs/from/ros/7/nd__log"


class Source:
    """What Zenoh's advanced publisher does: number, keep, answer in order."""

    def __init__(self, keeps: int, name: str = "a/1", first: int = 0, size: int = 10, key: str = KEY) -> None:
        self.name = name
        self.key = key
        self.number = first
        self.cache: deque[tuple[int, Sample]] = deque(maxlen=keeps)
        self._size = size

    def put(self, data: int | None = None) -> tuple[int, Sample]:
        value = self.number if data is None else data
        numbered = (self.number % NUMBERS, (self.key, value.to_bytes(self._size, "big")))
        self.cache.append(numbered)
        self.number += 1
        return numbered

    def answer(self, ask: Ask) -> list[tuple[int, Sample]]:
        first, _, last = ask.numbers.partition("..")
        found = []
        for number, sample in self.cache:
            ahead = (number - int(first)) % NUMBERS
            if ahead < NUMBERS // 2 and (not last or ahead <= (int(last) - int(first)) % NUMBERS):
                found.append((number, sample))
        return found


def values(samples: list[Sample]) -> list[int]:
    return [int.from_bytes(payload, "big") for _, payload in samples]


def take(to: Recovery, source: Source, numbered: tuple[int, Sample], now: float = 0.0) -> list[int]:
    return values(to.sample(source.name, *numbered, now))


def serve(to: Recovery, source: Source, now: float = 0.0, *, rounds: int = 50) -> list[int]:
    """Answer everything that is asked until nothing is."""
    freed: list[Sample] = []
    for _ in range(rounds):
        asks = to.asks(now)
        if not asks:
            return values(freed)
        for ask in asks:
            for number, sample in source.answer(ask):
                freed += to.reply(ask, number, sample, now)
            freed += to.ended(ask, now)
    raise AssertionError("it never stops asking")


def serve_one(to: Recovery, source: Source, ask: Ask, now: float = 0.0) -> list[int]:
    """Answer one question."""
    freed = [freed for number, sample in source.answer(ask) for freed in to.reply(ask, number, sample, now)]
    return values(freed + to.ended(ask, now))


@pytest.mark.parametrize("first", [0, 1000, NUMBERS - 3])
def test_what_is_in_order_passes(first: int) -> None:
    """Messages without a gap are delivered as they come, also where numbers begin again."""
    source, to = Source(10, first=first), Recovery()
    for n in range(10):
        assert take(to, source, source.put(n)) == [n]
    assert to.asks(0.0) == []
    assert to.misses() == []


@pytest.mark.parametrize("first", [0, NUMBERS - 5])
def test_a_gap_is_closed_in_order(first: int) -> None:
    """What is missing is asked for at once, and what came meanwhile waits for it."""
    source, to = Source(100, first=first), Recovery()
    assert take(to, source, source.put(0)) == [0]
    for n in range(1, 8):
        source.put(n)
    assert take(to, source, source.put(8)) == []
    assert serve(to, source) == [1, 2, 3, 4, 5, 6, 7, 8]
    assert take(to, source, source.put(9)) == [9]
    assert to.misses() == []


def test_nothing_is_delivered_twice() -> None:
    """A message that comes as an answer and by itself, in any order, is delivered once."""
    source, to = Source(100), Recovery()
    samples = [source.put() for _ in range(5)]
    assert take(to, source, samples[0]) == [0]
    assert take(to, source, samples[2]) == []
    assert serve(to, source) == [1, 2, 3, 4]
    assert [take(to, source, sample) for sample in samples] == [[]] * 5


def test_what_the_source_has_no_more_is_told_with_its_count() -> None:
    """A gap longer than what the source keeps is missed in part: counted exactly, told once, before what follows."""
    source, to = Source(10), Recovery()
    take(to, source, source.put())
    for _ in range(5000):
        source.put()
    assert take(to, source, source.put()) == []
    assert serve(to, source) == list(range(4992, 5002))
    assert to.misses() == [(KEY, 4991)]
    assert to.misses() == []


def test_a_last_message_is_found_by_the_heartbeat() -> None:
    """A loss that nothing follows is noticed when the source tells its newest number, and a moment is given to the
    message itself, which may have been overtaken."""
    source, to = Source(10), Recovery()
    take(to, source, source.put())
    source.put()
    to.heartbeat(source.name, KEY, 1, 0.0)
    assert to.asks(0.0) == []
    assert to.next_deadline() == OVERTAKEN_S
    assert serve(to, source, OVERTAKEN_S) == [1]
    to.heartbeat(source.name, KEY, 1, 1.0)
    assert to.next_deadline() == float("inf")


def test_an_overtaken_message_is_not_asked_for() -> None:
    """A heartbeat that comes just before its message costs nothing."""
    source, to = Source(10), Recovery()
    take(to, source, source.put())
    to.heartbeat(source.name, KEY, 1, 0.0)
    assert take(to, source, source.put()) == [1]
    assert to.next_deadline() == float("inf")


def test_what_was_sent_before_the_subscription_is_not_wanted() -> None:
    """A source that exists already begins with what it sends next, however it is noticed first."""
    for notice in ("reply", "heartbeat", "sample"):
        source, to = Source(10), Recovery()
        for _ in range(5):
            source.put()
        if notice == "reply":
            to.known(source.name, KEY, 4, 0.0)
        elif notice == "heartbeat":
            to.heartbeat(source.name, KEY, 4, 0.0)
        else:
            assert take(to, source, source.put()) == [5]
            to.known(source.name, KEY, 4, 0.0)
        to.settled = True
        assert serve(to, source, 1.0) == []
        n = source.number
        assert take(to, source, source.put()) == [n]


def test_a_new_source_is_wanted_from_its_first_message() -> None:
    """Of a source that came after the subscription, what was sent before it was heard is asked for."""
    source, to = Source(10), Recovery()
    to.settled = True
    for _ in range(4):
        source.put()
    to.heartbeat(source.name, KEY, 3, 0.0)
    assert serve(to, source, OVERTAKEN_S) == [0, 1, 2, 3]


def test_what_a_stranger_has_no_more_is_not_missed() -> None:
    """A source that was out of reach at the subscription may be old: what it has is delivered, nothing is counted."""
    source, to = Source(3), Recovery()
    to.settled = True
    for _ in range(100):
        source.put()
    assert take(to, source, source.put()) == []
    assert serve(to, source) == [98, 99, 100]
    assert to.misses() == []


def test_a_question_that_fails_is_asked_again() -> None:
    """Answers that break off leave a gap open: the rest is asked for, and a question without any answer again."""
    source, to = Source(100), Recovery()
    take(to, source, source.put())
    for _ in range(9):
        source.put()
    assert take(to, source, source.put()) == []
    (ask,) = to.asks(0.0)
    freed = [to.reply(ask, number, sample, 0.0) for number, sample in source.answer(ask)[:3]]
    assert [values(samples) for samples in freed] == [[1], [2], [3]]
    assert to.ended(ask, 0.0) == []
    (again,) = to.asks(0.0)
    assert again.first == 4
    assert to.ended(again, 0.0) == []
    assert to.asks(0.0) == []
    assert serve(to, source, to.next_deadline()) == [4, 5, 6, 7, 8, 9, 10]
    assert to.misses() == []


def test_one_empty_answer_proves_nothing() -> None:
    """A question whose answer was lost with its link, and the next one's not, costs no message."""
    source, to = Source(10_000), Recovery()
    take(to, source, source.put())
    for _ in range(5 * PIECE):
        source.put()
    take(to, source, source.put())
    (ask,) = to.asks(0.0)
    to.ended(ask, 0.0)
    (probe,) = to.asks(0.0)
    assert not probe.piece
    for number, sample in source.answer(probe):
        to.reply(probe, number, sample, 0.0)
    to.ended(probe, 0.0)
    assert serve(to, source) == list(range(1, 5 * PIECE + 2))
    assert to.misses() == []


def test_a_source_that_does_not_answer_is_given_up() -> None:
    """Where a rule lets messages pass and questions not, the gap is given up after a while, and counted."""
    source, to = Source(100), Recovery()
    now, delivered = 0.0, take(to, source, source.put())
    source.put()
    rounds = 0
    while len(delivered) < 2:
        delivered += take(to, source, source.put(), now)
        for ask in to.asks(now):
            delivered += values(to.ended(ask, now))
            rounds += 1
        now += 0.05
    assert delivered[:3] == [0, 2, 3]
    assert to.misses() == [(KEY, 1)]
    assert rounds <= 2 * ATTEMPTS
    assert 1.0 < now < 10.0


def test_a_stranger_that_does_not_answer_is_none_when_something_of_it_was_delivered() -> None:
    """What was before its first message is not counted; what is missing behind that is, however soon."""
    source, to = Source(100), Recovery()
    to.settled = True
    now = 0.0

    def given_up() -> list[int]:
        nonlocal now
        delivered: list[int] = []
        while not delivered:
            now += 0.05
            to.heartbeat(source.name, KEY, source.number - 1, now)  # it is heard, and does not answer
            for ask in to.asks(now):
                delivered += values(to.ended(ask, now))
        return delivered

    for _ in range(5):
        source.put()
    assert take(to, source, source.put(), now) == []
    assert given_up() == [5]
    assert to.misses() == []
    source.put()
    assert take(to, source, source.put(), now) == []
    assert given_up() == [7]
    assert to.misses() == [(KEY, 1)]


def test_a_source_out_of_reach_is_waited_for() -> None:
    """While nothing is heard of a source its gap stays open; once it is heard, the question comes at once."""
    source, to = Source(100), Recovery()
    take(to, source, source.put())
    source.put()
    take(to, source, source.put())
    now = 0.0
    while now < SILENT_S / 2:
        for ask in to.asks(now):
            assert to.ended(ask, now) == []
        now = max(now, to.next_deadline())
    to.heartbeat(source.name, KEY, 2, now)
    assert serve(to, source, now) == [1, 2]
    assert to.misses() == []


def test_a_source_that_is_gone_is_given_up() -> None:
    """What a dead source has taken with it is missed after a minute, and what came is delivered."""
    source, to = Source(100), Recovery()
    take(to, source, source.put())
    source.put()
    take(to, source, source.put())
    now, delivered = 0.0, list[int]()
    while not delivered:
        assert now < 2 * SILENT_S
        for ask in to.asks(now):
            delivered += values(to.ended(ask, now))
        now = max(now, to.next_deadline()) if to.next_deadline() < float("inf") else now
    assert delivered == [2]
    assert SILENT_S < now < SILENT_S + 2 * AWAY_S
    assert to.misses() == [(KEY, 1)]


def test_a_lost_link_frees_what_was_asked() -> None:
    """Answers of before a link was lost are not waited for; if they come after all, they count."""
    source, to = Source(100), Recovery()
    take(to, source, source.put())
    source.put()
    take(to, source, source.put())
    (old,) = to.asks(0.0)
    to.restart(0.1)
    (new,) = to.asks(0.1)
    assert values([s for n, sample in source.answer(old) for s in to.reply(old, n, sample, 0.1)]) == [1, 2]
    assert to.ended(old, 0.1) == []
    assert to.ended(new, 0.1) == []
    assert to.asks(10.0) == []


def test_large_messages_are_asked_for_in_small_pieces() -> None:
    """A question asks for about as much as a link can take at once."""
    for size, piece in ((10, PIECE), (PIECE_BYTES // 4, 4), (10 * PIECE_BYTES, 1)):
        source, to = Source(2000, size=size), Recovery()
        take(to, source, source.put())
        for _ in range(20):
            source.put()
        take(to, source, source.put())
        (ask,) = to.asks(0.0)
        assert ask.first == 1
        assert ask.last == (piece if piece < 20 else None)


def test_what_waits_behind_a_gap_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """When more waits than may, the gap is given up and counted, and delivery goes on."""
    monkeypatch.setattr(Recovery, "WAITING", 10)
    source, to = Source(5), Recovery()
    take(to, source, source.put())
    source.put()
    source.put()
    freed = [n for _ in range(11) for n in take(to, source, source.put())]
    assert freed == list(range(3, 14))
    assert to.misses() == [(KEY, 2)]


def test_what_waits_is_bounded_over_all_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many sources are invented under one key, what waits has one bound, and another key's gap stays open."""
    monkeypatch.setattr(Recovery, "WAITING_BYTES", 10_000)
    to, honest = Recovery(), Source(100, "honest", size=1000)
    take(to, honest, honest.put())
    honest.put()
    for _ in range(4):
        assert take(to, honest, honest.put()) == []
    waiting, delivered = 4, 0
    for n in range(200):
        invented = Source(1, f"invented/{n}", size=100, key="macs/from/ros/8/nd__log")
        take(to, invented, invented.put())
        invented.put()
        for _ in range(2):
            waiting += 1
            delivered += len(take(to, invented, invented.put()))
            assert 1000 * 4 + 100 * (waiting - 4 - delivered) <= 10_000
    assert delivered > 0
    assert {key for key, _ in to.misses()} == {"macs/from/ros/8/nd__log"}
    (ask,) = (ask for ask in to.asks(0.0) if ask.source == "honest")
    assert serve_one(to, honest, ask) == [1, 2, 3, 4, 5]


def test_a_source_has_its_name_to_itself() -> None:
    """Who sends under its own key with another's name takes none of its numbers, and its answers are not the
    other's."""
    true, false = Source(10), Source(10, key="macs/from/ros/8/nd__log")
    to = Recovery()
    assert take(to, true, true.put(0)) == [0]
    assert take(to, false, false.put(100)) == [100]
    assert take(to, false, false.put(101)) == [101]
    to.heartbeat(false.name, false.key, 1_000_000, 0.0)
    assert take(to, true, true.put(1)) == [1]
    true.put(2)
    assert take(to, true, true.put(3)) == []
    (ask,) = to.asks(0.0)
    assert (ask.key, ask.first) == (KEY, 2)
    assert to.reply(ask, 2, (false.key, b"false"), 0.0) == []
    assert serve_one(to, true, ask) == [2, 3]
    assert to.misses() == []


def test_the_source_not_heard_longest_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any number of sources may come and go: who is heard stays, and of who goes all that waited is delivered."""
    monkeypatch.setattr(Recovery, "SOURCES", 3)
    to, heard, silent = Recovery(), Source(10, "heard"), Source(10, "silent")
    for source in (heard, silent):
        take(to, source, source.put())
        source.put()
        assert take(to, source, source.put()) == []
    others = [Source(10, str(n)) for n in range(10)]
    delivered = []
    for other in others:
        to.heartbeat(heard.name, KEY, 2, 0.0)
        delivered.append(take(to, other, other.put(7)))
    assert delivered == [[7], [2, 7], *[[7]] * 8]
    assert to.misses() == [(KEY, 1)]
    assert serve(to, heard) == [1, 2]


def test_a_forgotten_source_goes_on_where_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a source keeps is not delivered again because it was forgotten; what came meanwhile is asked for. When
    even those that were forgotten are too many, it goes on with what comes next."""
    monkeypatch.setattr(Recovery, "SOURCES", 2)
    monkeypatch.setattr(Recovery, "FORGOTTEN", 5)
    to, source = Recovery(), Source(10)
    to.settled = True
    others = (Source(10, str(n)) for n in itertools.count())

    def forget(number: int) -> None:
        for other in itertools.islice(others, number):
            assert take(to, other, other.put(0)) == [0]

    for n in range(5):
        assert take(to, source, source.put(n)) == [n]
    forget(3)
    source.put(5)
    to.heartbeat(source.name, KEY, 5, 0.0)
    assert serve(to, source, OVERTAKEN_S) == [5]
    forget(20)
    assert take(to, source, source.put(6)) == [6]
    assert serve(to, source, OVERTAKEN_S) == []


def test_replies_that_are_dropped_here_are_asked_for_again() -> None:
    """That a first reply is missing proves nothing when it was dropped by us: nothing is skipped, and the question is
    repeated, not at once."""
    source, to = Source(100), Recovery()
    take(to, source, source.put())
    for _ in range(6):
        source.put()
    assert take(to, source, source.put()) == []
    now = 0.0
    for _ in range(3 * ATTEMPTS):
        (ask,) = to.asks(now)
        to.reply_dropped(ask)
        for number, sample in source.answer(ask)[3:]:
            assert to.reply(ask, number, sample, now) == []
        assert to.ended(ask, now) == []
        assert take(to, source, source.put(), now) == []
        assert now < to.next_deadline() < now + 1
        now = to.next_deadline()
    assert to.misses() == []
    assert serve(to, source, now) == list(range(1, source.number))
    assert to.misses() == []


def test_absurd_numbers_cost_nothing() -> None:
    """A heartbeat with any number keeps nobody busy, and what the source has sent is delivered."""
    source, to = Source(100), Recovery()
    take(to, source, source.put())
    to.heartbeat(source.name, KEY, NUMBERS // 2 - 5, 0.0)
    now, delivered, asked = OVERTAKEN_S, [], 0
    for _ in range(200):
        delivered += take(to, source, source.put(), now)
        for ask in to.asks(now):
            asked += 1
            for number, sample in source.answer(ask):
                delivered += values(to.reply(ask, number, sample, now))
            delivered += values(to.ended(ask, now))
        now += 0.1
    assert delivered[:30] == list(range(1, 31))
    assert asked < 100


@pytest.mark.parametrize("seed", range(30))
def test_any_losses_are_made_up_for(seed: int) -> None:
    """Whatever is lost, of messages, heartbeats and answers, all is delivered in order and once, or counted."""
    random_ = random.Random(seed)
    keeps = random_.choice([20, 200, 5000])
    source, to = Source(keeps, first=random_.choice([0, NUMBERS - 300])), Recovery()
    to.known(source.name, KEY, (source.number - 1) % NUMBERS, 0.0)
    to.settled = True
    now, delivered, missed, down_until = 0.0, [], 0, -1.0
    for step in range(4000):
        now += 0.005
        if random_.random() < 0.002:
            down_until = now + random_.random() * 2
        up = now > down_until
        late = step > 3500
        if step < 3600:
            numbered = source.put(step)
            if late or (up and random_.random() > 0.02):
                delivered += take(to, source, numbered, now)
        if step % 100 == 0 and (up or late):
            to.heartbeat(source.name, KEY, (source.number - 1) % NUMBERS, now)
        for ask in to.asks(now):
            answers = source.answer(ask) if up or late else []
            if not late and random_.random() < 0.2:
                answers = answers[: random_.randrange(len(answers) + 1)]  # the link broke
            for number, sample in answers:
                delivered += values(to.reply(ask, number, sample, now))
            delivered += values(to.ended(ask, now))
        missed += sum(count for _, count in to.misses())
    assert delivered == sorted(set(delivered))
    assert delivered[-1] == 3599
    assert len(delivered) + missed == 3600
    if keeps == 5000:
        assert missed == 0


def test_pauses_grow() -> None:
    """Questions without an answer become rarer."""
    assert list(recovery.PAUSES_S) == sorted(recovery.PAUSES_S)
