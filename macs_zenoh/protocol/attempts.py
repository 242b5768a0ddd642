"""Attempts to come in without a valid token: counted by address, told now and then, in bounded memory. Pure."""

from __future__ import annotations

from collections import OrderedDict

ADDRESSES = 256
"""So many are told apart; of more, the one that tried longest ago is forgotten."""

EVERY_S = 60.0
"""How often an address that goes on is named."""


class Attempts:
    """Those at one gateway."""

    def __init__(self) -> None:
        self._of: OrderedDict[str, tuple[int, float]] = OrderedDict()
        """By address: how many there have been, and when that was last told."""

    def __len__(self) -> int:
        return len(self._of)

    def note(self, address: str, now: float) -> int:
        """One more from an address. How many it has made, when that should be told; else 0."""
        count, told_at = self._of.pop(address, (0, now - EVERY_S))
        count += 1
        tell = now - told_at >= EVERY_S
        self._of[address] = count, now if tell else told_at
        if len(self._of) > ADDRESSES:
            self._of.popitem(last=False)
        return count if tell else 0
