"""What a check is, and what became of each. Pure.

A check has a name for life: reports of two versions can be compared by it. ``compatible`` ones hold what existing
programs rely on, ``strict`` ones also what the existing ones do badly. A check without a verdict at the end was never
tried.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import NamedTuple

from macs_zenoh.errors import MacsError


class Level(str, Enum):
    """How much is asked of a program."""

    COMPATIBLE = "compatible"
    """What existing programs rely on and do themselves."""
    STRICT = "strict"
    """And what existing programs do badly (docs/compatibility.md)."""


class Outcome(str, Enum):
    """What became of a check."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


class Check(NamedTuple):
    """One thing that must hold, in words; ``deafens_existing``: the existing headset is known to go deaf there."""

    name: str
    about: str
    level: Level = Level.COMPATIBLE
    deafens_existing: bool = False


class Verdict(NamedTuple):
    """What became of one check, and why where it did not pass."""

    check: Check
    outcome: Outcome
    why: str = ""


class NotHeld(MacsError):
    """What a check asks does not hold; the text says what was seen instead."""


class NotTried(MacsError):
    """A check cannot be tried on this program; the text says why."""


class Verdicts:
    """The checks of one run, with what is known of each. The first failure of a check is kept, nothing undoes it."""

    def __init__(self, checks: Iterable[Check], level: Level = Level.STRICT) -> None:
        self._checks = {check.name: check for check in checks}
        self._level = level
        self._known: dict[str, Verdict] = {}

    def asked(self, name: str) -> bool:
        """Whether a check belongs to the level of this run."""
        return self._level is Level.STRICT or self._checks[name].level is Level.COMPATIBLE

    def hold(self, name: str, held: object = True, why: str = "") -> bool:
        """It was seen to hold, or with ``held`` false not to, and ``why``. Whether it did."""
        if not held:
            self.fail(name, why)
        elif name not in self._known or self._known[name].outcome is Outcome.SKIPPED:
            self._set(name, Outcome.PASSED, "")
        return bool(held)

    def fail(self, name: str, why: str) -> None:
        """It does not hold."""
        if name not in self._known or self._known[name].outcome is not Outcome.FAILED:
            self._set(name, Outcome.FAILED, why)

    def skip(self, name: str, why: str) -> None:
        """It was not tried; a verdict that there is stays."""
        if name not in self._known:
            self._set(name, Outcome.SKIPPED, why)

    def failed(self, name: str) -> bool:
        """Whether it is known not to hold."""
        return name in self._known and self._known[name].outcome is Outcome.FAILED

    def all(self) -> list[Verdict]:
        """What became of every check of this level, in the order of the list."""
        asked = (check for check in self._checks.values() if self.asked(check.name))
        return [self._known.get(check.name, Verdict(check, Outcome.SKIPPED, "never came up")) for check in asked]

    def _set(self, name: str, outcome: Outcome, why: str) -> None:
        self._known[name] = Verdict(self._checks[name], outcome, why)
