"""Answers that are looked for: the first of each question, in whatever order they come, and why there is none."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import zenoh

from macs_zenoh.errors import MacsError, NotServed, Refused
from macs_zenoh.mesh.answers import UNANSWERED, Answers
from tests.support.waiting import until


class Payload:
    """Bytes, as Zenoh has them."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.payload = self

    def to_bytes(self) -> bytes:
        """What they are."""
        return self._data


class Replies:
    """What has come for one question."""

    def __init__(self) -> None:
        self.ok: Payload | None = None
        self.err: Payload | None = None
        self.ended = False
        self.looked = 0

    def try_recv(self) -> Replies | None:
        """As Zenoh's handler does it."""
        self.looked += 1
        if self.ok or self.err:
            reply = Replies()
            reply.ok, reply.err = self.ok, self.err
            self.ok = self.err = None
            return reply
        if self.ended:
            raise zenoh.ZError
        return None


Told = dict[str, bytes | MacsError]


def asked(answers: Answers, told: Told, of: int, *names: str) -> list[Replies]:
    """Questions that are put to somebody, and what will come for each."""
    replies = [Replies() for _ in names]

    def tell(name: str) -> Callable[[bytes | MacsError], None]:
        return lambda answer: told.update({name: answer})

    for name, each in zip(names, replies, strict=True):
        answers.expect(of, name, 1.0, each, tell(name))  # type: ignore[arg-type]
    return replies


async def test_each_question_has_its_answer_or_why_there_is_none() -> None:
    """An answer, a refusal, and that nobody serves it, each for the question that it answers."""
    answers, told = Answers(), Told()
    first, second, third = asked(answers, told, 1, "a", "b", "c")
    second.ok = Payload(b"yes")
    third.err = Payload(b'{"refused": "no"}')
    await until(lambda: len(told) == 2)
    first.ended = True
    await until(lambda: len(told) == 3)
    assert (told["b"], type(told["c"]), type(told["a"])) == (b"yes", Refused, NotServed)


async def test_an_answer_is_found_behind_many_that_do_not_come() -> None:
    """Who answers the last of many questions only is heard, and so is somebody else; each is told once."""
    answers, told = Answers(), Told()
    many = asked(answers, told, 1, *(f"{number}" for number in range(3 * UNANSWERED)))
    (other,) = asked(answers, told, 2, "other")
    many[-1].ok = other.ok = Payload(b"")
    await until(lambda: told.keys() == {f"{len(many) - 1}", "other"})
    looked = many[0].looked
    await until(lambda: many[0].looked > looked)
    assert many[-1].looked > 1
    answers.close()


async def test_an_answer_is_found_behind_such_while_others_are_answered() -> None:
    """However busy it is with others' answers, somebody who has left many questions open is heard."""
    answers, told = Answers(), Told()
    many = asked(answers, told, 1, *(f"{number}" for number in range(3 * UNANSWERED)))
    going = True

    def ask_again(answer: bytes | MacsError) -> None:
        if going:
            other = Replies()
            other.ok, other.ended = Payload(b""), True
            answers.expect(2, "other", 1.0, other, ask_again)  # type: ignore[arg-type]

    ask_again(b"")
    many[-1].ok = Payload(b"")
    await until(lambda: bool(told))
    going = False
    answers.close()


async def test_all_answers_are_taken_until_there_can_be_no_more() -> None:
    """The first one is told; those behind it are taken from Zenoh, which logs each that nobody takes."""
    answers, told = Answers(), Told()
    (replies,) = asked(answers, told, 1, "a")
    replies.ok = Payload(b"1")
    await until(lambda: told == {"a": b"1"})
    replies.ok = Payload(b"2")
    await until(lambda: replies.ok is None)
    assert told == {"a": b"1"}
    looked, replies.ended = replies.looked, True
    await until(lambda: replies.looked > looked and answers._looking is None)


async def test_who_never_ends_his_answers_does_not_hold_up_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of those to which more may come a look takes as many as there is time for, each in its turn."""
    answers, told = Answers(), Told()
    replies = asked(answers, told, 1, "a", "b", "c")
    for each in replies:
        each.ok = Payload(b"1")
    monkeypatch.setattr("macs_zenoh.mesh.answers.TURN_S", -1.0)  # time is always over
    await until(lambda: len(told) == 3)
    for wanted in range(1, 4):
        await until(lambda wanted=wanted: all(each.looked > 2 + wanted for each in replies))  # type: ignore[misc]
        assert max(each.looked for each in replies) <= min(each.looked for each in replies) + 1
    answers.close()


async def test_an_answer_that_cannot_be_handled_costs_no_other(caplog: pytest.LogCaptureFixture) -> None:
    """It is logged, and the next one told; who asks again at once hears of that too."""
    answers, told = Answers(), Told()

    def fail(answer: bytes | MacsError) -> None:
        asked(answers, told, 1, "again")[0].ok = Payload(b"2")
        raise ValueError

    failing = Replies()
    failing.ok = Payload(b"")
    answers.expect(1, "failing", 1.0, failing, fail)  # type: ignore[arg-type]
    asked(answers, told, 1, "next")[0].ok = Payload(b"1")
    await until(lambda: told == {"next": b"1", "again": b"2"})
    assert "an answer was not handled" in caplog.text
