"""`macs_zenoh.mesh.followed`: who left between an answer and a watcher's first news is let go of, and nobody else."""

from __future__ import annotations

import pytest

from macs_zenoh.mesh import followed
from macs_zenoh.mesh.followed import Followed


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(followed, "CONFIRM_S", 0.0)


async def followed_by(answered: list[str], news: list[tuple[str, bool]], *later: list[str]) -> set[str]:
    """Who is there in the end: those answered, the watcher's news, and what is answered when it is asked again."""
    there: set[str] = set()
    answers = iter(later)

    def receive(token: str, alive: bool) -> None:
        (there.add if alive else there.discard)(token)

    async def ask() -> list[str]:
        return next(answers)

    following = Followed(answered, receive)
    assert there == set(answered)
    for token, alive in news:
        following.told(token, alive)
    await following.confirm(ask)
    return there


async def test_who_left_unseen_is_let_go_of() -> None:
    """It is in no news, and not in later answers."""
    assert await followed_by(["a", "b"], [("b", True)], [], []) == {"b"}


async def test_who_is_there_stays() -> None:
    """Where the watcher has told of it, or where one of two later answers names it."""
    assert await followed_by(["a", "b", "c"], [("a", True)], ["b"], ["c"]) == {"a", "b", "c"}
    assert await followed_by(["a"], [], [], ["a"]) == {"a"}


async def test_news_are_what_they_are() -> None:
    """Who comes later is there, who is told to have left is not, whatever was answered."""
    assert await followed_by(["a"], [("a", False), ("b", True)]) == {"b"}
    assert await followed_by(["a"], [("a", False), ("a", True)]) == {"a"}


async def test_one_that_is_told_of_while_it_is_asked_stays() -> None:
    """News that come after the question count, though the answer is of before."""
    there = {"a"}
    following = Followed(["a"], lambda token, alive: (there.add if alive else there.discard)(token))

    async def ask() -> list[str]:
        following.told("a", True)
        return []

    await following.confirm(ask)
    assert there == {"a"}
