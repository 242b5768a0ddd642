"""The table of attacks: what an attack is, and how one gets into the table."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tests.attack.ways import Way

By = Literal["headset", "tcp robot", "mesh", "operator", "certificate"]
"""Who attacks: a TCP agent of either type, a Zenoh session without any right but the router's address, one that calls
itself an operator, or one with a certificate, on a site that lets in nobody else."""


@dataclass
class Target:
    """The site that is attacked, and for how long: the time begins when the attack first asks whether it goes on, so
    that it can make its frames before that."""

    port: int
    """Of its gateway."""
    endpoint: str
    """Of its router."""
    seconds: float
    begins: Callable[[], object] = lambda: None
    robot: int = 1
    pki: Path | None = None
    """Where everybody's certificates and settings are, if the site has any."""
    _ends: float | None = None

    def running(self) -> bool:
        """Whether the attack goes on."""
        if self._ends is None:
            self._ends = time.monotonic() + self.seconds
            self.begins()
        return time.monotonic() < self._ends

    def rest(self, seconds: float) -> bool:
        """Wait, at most to the end; whether the attack goes on."""
        if self.running():
            time.sleep(max(0.0, min(seconds, (self._ends or 0.0) - time.monotonic())))
        return self.running()


@dataclass(frozen=True)
class Attack:
    """One row. ``single``: few frames, each of which must cost nobody anything; otherwise a flood. ``seen``: with this
    one a site was once brought down or a stop lost; the others are its kin."""

    name: str
    section: int
    by: By
    single: bool
    seen: bool
    run: Callable[[Target], None]
    addressed: bool = False
    """Whether it sends to the neighbours themselves, who take it as well as they can."""
    way: Way | None = None
    """The only way in that has what it attacks; None: whichever."""

    @property
    def certified(self) -> bool:
        """Whether it needs a site with certificates."""
        return self.by == "certificate"

    @property
    def says(self) -> str:
        """What is sent."""
        return " ".join((self.run.__doc__ or "").split())


ATTACKS: dict[str, Attack] = {}


def attack(
    section: int, by: By, *, single: bool = False, seen: bool = False, way: Way | None = None
) -> Callable[[Callable[[Target], None]], Attack]:
    """Put a function into the table. ``section`` is the class of faults that it looks for:

    1 size and cost before parsing, 2 budgets, 3 the way of the stop, 4 other people's values, 5 rights.
    """

    return lambda run: enter(run, section, by, single=single, seen=seen, way=way)


def enter(
    run: Callable[[Target], None],
    section: int,
    by: By,
    *,
    single: bool = False,
    seen: bool = False,
    addressed: bool = False,
    way: Way | None = None,
) -> Attack:
    """Put a function into the table, under its name."""
    row = Attack(run.__name__, section, by, single, seen, run, addressed, way)
    assert row.says, f"{row.name} does not say what it sends"
    assert ATTACKS.setdefault(row.name, row) is row, f"two attacks are called {row.name}"
    return row


def every() -> dict[str, Attack]:
    """All rows, by name."""
    from tests.attack import floods, inputs, insiders, returning, robots, sessions, web  # noqa: F401 - they fill the table

    return ATTACKS
