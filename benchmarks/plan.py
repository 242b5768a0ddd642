"""How much is measured, in which order, and what was lost meanwhile."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from .figures import Figure
from .processes import Stage

KIB = 1 << 10
MIB = 1 << 20

QUIET_S = 3.0
"""Nothing came for so long: what is missing by then is lost, or late."""
LATE_S = 10.0
"""The same, for what is late."""

RELAYS = 3
"""So many plain relays take turns: `in_rotation`."""

Run = Callable[[], float]
"""One measurement: its rate per second, or its time."""


@dataclass
class Plan:
    """How much is measured. ``delivered`` and ``lost`` count messages over everything that was counted."""

    rounds: int = 5
    scale: float = 1.0
    delivered: int = 0
    lost: int = 0
    lost_where: list[str] = field(default_factory=list)
    late_where: list[str] = field(default_factory=list)
    peers: dict[str, str] = field(default_factory=dict)
    """Where other programs listen, by their names."""

    def count(self, size: int, fan_out: int = 1) -> int:
        """How many messages of a size make one measurement: about half a second, at least 8."""
        wanted = min(60_000, 400 * MIB // max(1, size)) // (2 if fan_out > 1 else 1) / fan_out**0.5
        return max(8, int(wanted * self.scale))

    def arrived(self, where: str, expected: int, got: int, late: int = 0) -> bool:
        """Note what arrived of what was sent, and what when nobody waited for it any more; True when all came in time.
        A round in which it did not counts as nothing."""
        self.delivered += got + late
        missing = expected - got - late
        if missing:
            self.lost += missing
            self.lost_where.append(f"{where}: {missing} of {expected}")
        if late:
            self.late_where.append(f"{where}: {late} of {expected}, after {QUIET_S:g} s without any")
        return got == expected


def in_turn(rounds: int, runs: dict[str, Run]) -> dict[str, list[float]]:
    """Every run once, then every run once more, and so on: what the machine does meanwhile meets all of them."""
    values: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            values[name].append(run())
    return values


def in_rotation(runs: Sequence[Run]) -> Run:
    """Of processes that are alike another one each time: how fast one is with large messages (a relay at 64 KiB 0.7 to
    1.5 GB/s) depends on where its memory came to lie, and stays so as long as it lives."""
    turns = itertools.cycle(runs)
    return lambda: next(turns)()


Case = Callable[[Stage, Plan], Iterator[Figure]]
"""One thing that is measured. The first line of its docstring says what."""
