"""How much of something all have together, those at one address, and each. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable


class Budget:
    """Amounts by holder: each has at most ``each``, those at one address ``per_address``, all together ``total``.

    The last quarter of the total is for those who have little, a sixteenth of what each may have: whoever takes much
    cannot keep others from what they need.
    """

    def __init__(self, what: str, *, each: int, per_address: int, total: int) -> None:
        self._what = what
        self._each = each
        self._few = max(1, each // 16)
        self._per_address = per_address
        self._total = total
        self._open_to_all = total - total // 4
        self._of: dict[Hashable, int] = {}
        self._at: Counter[str] = Counter()
        self.used = 0

    def of(self, holder: Hashable) -> int:
        """What somebody has."""
        return self._of.get(holder, 0)

    def judge(self, holder: Hashable, address: str, more: int = 1) -> str | None:
        """Why somebody at this address may not have ``more`` than now, None when it may."""
        mine = self._of.get(holder, 0) + more
        if mine > self._each:
            return f"each may have {self._each} {self._what}"
        if self._at.get(address, 0) + more > self._per_address:
            return f"all at one address may have {self._per_address} {self._what}"
        if self.used + more > (self._total if mine <= self._few else self._open_to_all):
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
