"""Who hands out which ids, and who keeps one that several have. Pure: who else holds what comes in, a choice goes out.

A gateway leases a *block*, 256 ids with the same high byte, and gives them to the agents that connect to it, from 1
up, as they are used to. A lease is a liveliness token that carries the holder's Zenoh id; when two choose the same
thing at once, the smaller Zenoh id keeps it and the other chooses again. The same rule settles single ids.

Two parts of a mesh that could not see each other may have chosen the same; `Contests` settles that when they meet.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Generic, TypeVar

from .keyexpr import BLOCK_SIZE, block_of

T = TypeVar("T", bound=Hashable)

PATIENCE_S = 1.5
"""How long the rightful holder of something leased waits for the others to give way, which takes them 0.3 s."""

GATEWAY_PATIENCE_S = 10.0
"""The same for an id that is another gateway's: it is never configured, and hundreds may have to change at once."""

COMPLAINT_S = 2 * PATIENCE_S
"""After so long nobody will give way any more: what is configured twice stays so until a person changes it."""

BLOCKS = 256
"""Blocks on one mesh: ids are 16 bits."""


def free_blocks(taken: Collection[int], count: int = 1) -> list[int]:
    """The lowest ``count`` blocks that nobody holds; fewer when there are not so many."""
    return list(islice((block for block in range(BLOCKS) if block not in taken), count))


def keeps(mine: str, claimants: Iterable[str]) -> bool:
    """Whether the holder with Zenoh id ``mine`` keeps what all ``claimants`` hold a token for."""
    return all(mine <= other for other in claimants)


class FreeIds:
    """The ids of our blocks that nobody of ours has: those never given out first, from the lowest, then the one that
    is free for the longest. So what is still on its way to somebody who left finds nobody, rather than the next one.

    To take one costs the same however many are given out.
    """

    LOOKS = 64
    """How many ids that others had are looked at again when there are no more: the rest when the next is wanted."""

    def __init__(self) -> None:
        self._blocks: set[int] = set()
        self._given: set[int] = set()
        self._fresh: deque[int] = deque()
        self._used: deque[int] = deque()
        self._elsewhere: deque[int] = deque()

    def __len__(self) -> int:
        """How many there are, as far as is known: of those that others had when they were looked at, none."""
        return len(self._fresh) + len(self._used)

    def add_block(self, block: int) -> None:
        """A block is ours: its ids may be given out. Id 0 is no id. Twice changes nothing."""
        if block not in self._blocks:
            self._blocks.add(block)
            first = block * BLOCK_SIZE
            self._fresh += [i for i in range(max(1, first), first + BLOCK_SIZE) if i not in self._given]

    def remove_block(self, block: int) -> None:
        """A block is not ours any more."""
        self._blocks.discard(block)
        for ids in (self._fresh, self._used, self._elsewhere):
            kept = [i for i in ids if block_of(i) != block]
            ids.clear()
            ids += kept

    def take(self, is_elsewhere: Callable[[int], bool]) -> int | None:
        """An id that neither we have given out nor others have, as ``is_elsewhere`` says; None when there is none."""
        while ids := self._fresh or self._used:
            agent_id = ids.popleft()
            if not is_elsewhere(agent_id):
                self._given.add(agent_id)
                return agent_id
            self._elsewhere.append(agent_id)
        for _ in range(min(self.LOOKS, len(self._elsewhere))):
            agent_id = self._elsewhere.popleft()
            if not is_elsewhere(agent_id):
                self._given.add(agent_id)
                return agent_id
            self._elsewhere.append(agent_id)
        return None

    def give_back(self, agent_id: int) -> None:
        """Whoever had an id has it no more. One that was not given out, or is not of our blocks, is none of ours."""
        if agent_id in self._given:
            self._given.remove(agent_id)
            if block_of(agent_id) in self._blocks:
                self._used.append(agent_id)


class Epochs:
    """Which of those that had an id one after the other in one session somebody is: a number that differs from that
    of the one before, and comes again.

    It is in the key of his presence, and Zenoh keeps what it has for a key for as long as a session is open, in the
    session and in its routers: 3 KB, and each makes the next dearer (measured with 1.10.2). So keys must come again.
    """

    MOST = 8
    """For so many an id has one after the other nobody sees two as the same one, not even who was away meanwhile."""
    AGENTS = 64 << 10

    def __init__(self) -> None:
        self._last: OrderedDict[tuple[int, int], tuple[int, int]] = OrderedDict()
        """Whose an id is or was: which of all connections, and its epoch."""

    def of(self, agent: tuple[int, int], connection: int) -> int:
        """That of a connection, by its number among all; the next one if it is new."""
        last, epoch = self._last.get(agent, (0, 0))
        if last != connection:
            epoch = epoch % self.MOST + 1
            self._last[agent] = connection, epoch
            self._last.move_to_end(agent)
            if len(self._last) > self.AGENTS:
                self._last.popitem(last=False)
        return epoch


def free_id(taken: Collection[int], leased_blocks: Collection[int] = ()) -> int | None:
    """The lowest id that is neither taken nor inside somebody's block."""
    return next((i for i in range(1, 0x10000) if i not in taken and block_of(i) not in leased_blocks), None)


@dataclass(frozen=True)  # a NamedTuple that is generic needs Python 3.11
class Verdict(Generic[T]):
    """What to do about something of ours that ``others`` (Zenoh ids) hold as well: give way, or tell a person."""

    what: T
    others: list[str]
    give_way: bool


@dataclass
class _Contest:
    others: frozenset[str]
    since: float
    settled: bool = False


class Contests(Generic[T]):
    """What we hold and others hold as well: ids, or blocks.

    Of several that leased the same the smallest Zenoh id keeps it. What is configured (``fixed``) is never given up;
    so whoever only leased it gives way after its patience even with the smallest Zenoh id, and where nobody can,
    each tells it once. ``gateway`` says of a Zenoh id whether it is a gateway's, where that matters.
    """

    def __init__(
        self, mine: str, fixed: Callable[[T], bool], gateway: Callable[[str], bool] = lambda zid: False
    ) -> None:
        self._mine = mine
        self._fixed = fixed
        self._gateway = gateway
        self._open: dict[T, _Contest] = {}

    def __contains__(self, what: object) -> bool:
        return what in self._open

    def look(self, contested: Mapping[T, Collection[str]], now: float) -> list[T]:
        """All that is contested now, with the others' Zenoh ids. Returns what is so no longer."""
        over = [what for what in self._open if not contested.get(what)]
        for what in over:
            del self._open[what]
        for what, zids in contested.items():
            others = frozenset(zids)
            before = self._open.get(what)
            if others and (before is None or not others <= before.others):
                self._open[what] = _Contest(others, now)
        return over

    def judge(self, now: float) -> list[Verdict[T]]:
        """What is to be done now; each is told once."""
        verdicts = []
        for what, contest in self._open.items():
            if not contest.settled and now >= self._due(what, contest):
                contest.settled = True
                verdicts.append(Verdict(what, sorted(contest.others), not self._fixed(what)))
        return verdicts

    def next_deadline(self) -> float | None:
        """When `judge` has something to say, None when it has not."""
        return min((self._due(what, c) for what, c in self._open.items() if not c.settled), default=None)

    def _due(self, what: T, contest: _Contest) -> float:
        if self._fixed(what):
            return contest.since + COMPLAINT_S
        if not keeps(self._mine, contest.others):
            return contest.since
        return contest.since + (GATEWAY_PATIENCE_S if all(map(self._gateway, contest.others)) else PATIENCE_S)
