"""How much of something all have together, those at one address, and each. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from typing import Generic, TypeVar

FEW = 16
"""Who has less than this part of what each may have has little."""


def may_have_one_more(used: int, mine: int, *, each: int, total: int, more: int = 1) -> bool:
    """Whether somebody who has ``mine`` of ``used`` in all may have one more, or so many.

    The last quarter of the total is for those who have little: whoever takes much cannot keep others from what they
    need.
    """
    has_little = mine + more <= max(1, each // FEW)
    return mine + more <= each and used + more <= (total if has_little else total - total // 4)


class Budget:
    """Amounts by holder: each has at most ``each``, those at one address ``per_address``, all together ``total``, of
    which the last quarter is for those who have little (`may_have_one_more`)."""

    def __init__(self, what: str, *, each: int, per_address: int, total: int) -> None:
        self._what = what
        self._each = each
        self._per_address = per_address
        self._total = total
        self._of: dict[Hashable, int] = {}
        self._at: Counter[str] = Counter()
        self.used = 0

    def of(self, holder: Hashable) -> int:
        """What somebody has."""
        return self._of.get(holder, 0)

    def at(self, address: str) -> int:
        """What all at one address have."""
        return self._at.get(address, 0)

    def judge(self, holder: Hashable, address: str, more: int = 1) -> str | None:
        """Why somebody at this address may not have ``more`` than now, None when it may."""
        mine = self._of.get(holder, 0)
        if mine + more > self._each:
            return f"each may have {self._each} {self._what}"
        if self._at.get(address, 0) + more > self._per_address:
            return f"all at one address may have {self._per_address} {self._what}"
        if not may_have_one_more(self.used, mine, each=self._each, total=self._total, more=more):
            return f"all together may have {self._total} {self._what}"
        return None

    def set(self, holder: Hashable, address: str, amount: int) -> None:
        """Somebody has so much now; with 0 it is forgotten."""
        change = amount - self._of.get(holder, 0)
        if amount:
            self._of[holder] = amount
        else:
            self._of.pop(holder, None)
        self._at[address] += change
        if self._at[address] <= 0:
            del self._at[address]
        self.used += change


class Ever:
    """Things that are never given back once somebody had them: each holder has at most ``each`` different ones, all
    together ``total``, as in `Budget`."""

    def __init__(self, *, each: int, total: int) -> None:
        self._each = each
        self._total = total
        self._of: dict[Hashable, set[Hashable]] = {}
        self.used = 0

    def may(self, holder: Hashable, what: Hashable) -> bool:
        """Whether somebody may have this, as one who has it already may. What he may have he has from now on."""
        his = self._of.get(holder, ())
        if what in his:
            return True
        if not may_have_one_more(self.used, len(his), each=self._each, total=self._total):
            return False
        self._of.setdefault(holder, set()).add(what)
        self.used += 1
        return True


class Toll:
    """Slows whoever asks for more work than ``per_s``: a second's worth is free at once, beyond that each piece is
    paid for with time."""

    FREE_S = 1.0
    """Who comes back registers all at once, and a stop may be behind that."""

    LONGEST_S = 0.25
    """An existing headset freezes when nobody reads from it for long."""

    def __init__(self, per_s: float) -> None:
        self._each_s = 1 / per_s
        self._paid_until = 0.0

    def pay(self, now: float, pieces: int = 1) -> float:
        """Work is done for it: for how many seconds nothing more should be taken from it."""
        self._paid_until = max(now - self.FREE_S, self._paid_until) + pieces * self._each_s
        return min(self.LONGEST_S, max(0.0, self._paid_until - now))


Holder = TypeVar("Holder", bound=Hashable)


class Unfinished(Generic[Holder]):
    """Bytes of frames that have begun, by who sends them. Beyond ``total`` one has to go: of the address that has most
    the one that began first, for frames of those who mean well end soon, and nobody is to cost others theirs. Up to
    ``free`` of each are not counted."""

    def __init__(self, free: int, total: int) -> None:
        self._free = free
        self._total = total
        self._of: dict[Holder, tuple[str, int]] = {}
        self._at: Counter[str] = Counter()
        self.used = 0

    def __contains__(self, holder: object) -> bool:
        return holder in self._of

    def note(self, holder: Holder, address: str, amount: int) -> list[Holder]:
        """So much of a frame is there; 0 when it has ended. Returns whose connections have to be closed."""
        _, before = self._of.get(holder, (address, 0))
        if amount < before or amount <= self._free:  # it has ended, and maybe the next one has begun
            self._forget(holder)
            before = 0
        if amount > self._free:
            self._of[holder] = (address, amount)
            self._count(address, amount - before)
        gone = []
        while self.used > self._total:
            most = max(self._at, key=self._at.__getitem__)
            oldest = next(each for each, (where, _) in self._of.items() if where == most)
            self._forget(oldest)
            gone.append(oldest)
        return gone

    def _forget(self, holder: Holder) -> None:
        address, amount = self._of.pop(holder, ("", 0))
        self._count(address, -amount)

    def _count(self, address: str, change: int) -> None:
        self.used += change
        self._at[address] += change
        if self._at[address] <= 0:
            del self._at[address]
