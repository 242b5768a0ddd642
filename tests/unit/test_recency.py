"""What somebody says behind an answer was said after the question."""

from __future__ import annotations

import math

from macs_zenoh.protocol.recency import QUESTIONS, Recency


def asked(recency: Recency, now: float) -> int:
    number = recency.ask(now)
    assert number is not None
    return number


def test_what_comes_behind_an_answer_is_younger_than_the_question() -> None:
    """Nothing is known at first; then the last question that was answered counts."""
    recency = Recency()
    assert recency.age_at_most(5.0) == math.inf
    first, second = asked(recency, 5.0), asked(recency, 5.4)
    assert QUESTIONS < first < second < 1 << 31, "existing programs read it as 32 bits with a sign"
    recency.answered(first, 5.5, math.inf)
    assert recency.age_at_most(6.0) == 1.0
    recency.answered(second, 6.0, math.inf)
    assert math.isclose(recency.age_at_most(6.0), 0.6)


def test_answers_to_nothing_prove_nothing() -> None:
    """Numbers that nobody asked, or that were answered before, and answers that come out of order."""
    recency = Recency()
    first, second = asked(recency, 1.0), asked(recency, 2.0)
    recency.answered(second, 2.1, math.inf)
    since = recency.age_at_most(3.0)
    for number in (first, second, QUESTIONS, QUESTIONS + 77):
        recency.answered(number, 3.0, math.inf)
        assert recency.age_at_most(3.0) == since


def test_only_so_many_questions_are_open() -> None:
    """Who does not read gets no more of them."""
    recency = Recency()
    numbers = [recency.ask(float(n)) for n in range(Recency.OPEN + 3)]
    assert numbers[Recency.OPEN :] == [None] * 3
    recency.answered(numbers[0] or 0, 9.0, math.inf)
    assert recency.ask(9.0) is not None


def test_slow_answers_count_against_it_only_while_it_speaks_steadily() -> None:
    """A network that stood still makes an answer late as well; one that reads slowly answers late again and again."""
    recency = Recency()
    recency.answered(asked(recency, 1.0), 1.1, 0.0)
    assert recency.is_quick
    for second in range(10, 20):
        recency.answered(asked(recency, second), second + 0.9, second + 0.5)
    assert recency.is_quick, "what it said had a gap since the question"
    for second in range(20, 20 + Recency.SLOW):
        assert recency.is_quick
        recency.answered(asked(recency, second), second + 0.9, 19.0)
    assert not recency.is_quick
    recency.answered(asked(recency, 30.0), 30.1, 19.0)
    assert recency.is_quick


def test_questions_that_nobody_answers_are_open_only_for_a_while() -> None:
    """As many as may be open get lost: later ones are asked nevertheless, and their answers count."""
    recency = Recency()
    lost = [asked(recency, float(n)) for n in range(Recency.OPEN)]
    assert recency.ask(Recency.LOST_S) is None
    found = asked(recency, 0.1 + Recency.LOST_S)
    recency.answered(lost[0], 10.2, -math.inf)
    assert recency.age_at_most(10.2) == math.inf, "it was given up"
    recency.answered(found, 10.3, -math.inf)
    assert recency.is_quick
    assert math.isclose(recency.age_at_most(10.3), 0.2)
    assert asked(recency, 10.4) > found


def test_a_number_that_nobody_asked_ends_no_question() -> None:
    """Or whoever says one would take the answers behind it away."""
    recency = Recency()
    number = asked(recency, 1.0)
    for wrong in (QUESTIONS, number - 1, number + 1):
        recency.answered(wrong, 1.1, -math.inf)
    recency.answered(number, 1.2, -math.inf)
    assert math.isclose(recency.age_at_most(1.2), 0.2)
