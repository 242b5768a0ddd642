"""What must hold under an attack, as figures and limits. Pure: times in seconds, sizes in bytes.

Two readings of the same figures. *Strictly* the promises of docs/security.md: a neighbour's p99 within five times the
calm one for single frames and within 20 ms for floods, a stop within 100 ms, the dead-man within its time and 100 ms;
where an equal load that attacks nobody was slower than that, it is the measure. *Roughly*, for machines on which
anything may run beside the tests: bounds that health keeps even there and that each of the faults broke by seconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

MIB = 1 << 20

SINGLE_TIMES = 5.0
FLOOD_S = 0.020
STOP_S = 0.100
ROUGH_P99_S = 1.0
ROUGH_LONGEST_S = 2.5
ROUGH_STOP_S = 1.0
OF_BENIGN = 1.5
"""So much more than under the equal load may be chance."""
ROUGHLY_OF_BENIGN = 5.0


def percentile(values: Sequence[float], share: float) -> float:
    """The value below which this share lies; 0 of nothing."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, math.ceil(share * len(ordered)) - 1)] if ordered else 0.0


@dataclass
class Window:
    """What was measured in one stretch of time."""

    latencies: list[float] = field(default_factory=list)
    """Of the neighbours' messages, from when each was due; infinite for what never came."""
    commands: list[float] = field(default_factory=list)
    """Of the driver's commands, to the robot's wheels; infinite likewise."""
    stops: list[float] = field(default_factory=list)
    """From pressing once to no more motion; infinite when it had no effect."""
    at_rest: int = 0
    """How often the driver could not get the robot to move before a stop was pressed, or the driver let go."""
    late_commands: int = 0
    """Carried out between a stop that held and its release."""
    deadman: list[float] = field(default_factory=list)
    """Beyond the dead-man's own time, from the last command."""
    trips: int = 0
    """Times that the dead-man stopped a robot whose driver was driving."""

    @property
    def p99(self) -> float:
        """Of the neighbours' messages."""
        return percentile(self.latencies, 0.99)

    @property
    def longest(self) -> float:
        """Of the neighbours' messages."""
        return max(self.latencies, default=0.0)


@dataclass
class Memory:
    """Of one program, in bytes."""

    before: int
    peak: int = 0
    after: int = 0

    @property
    def grown(self) -> int:
        """At its peak."""
        return max(0, self.peak - self.before)

    @property
    def kept(self) -> int:
        """When the attacker had left."""
        return max(0, self.after - self.before)


@dataclass
class Report:
    """One attack: the same stretch of time without one, beside one on another site, and under it."""

    name: str
    single: bool
    calm: Window
    benign: Window
    under: Window
    memory: dict[str, Memory] = field(default_factory=dict)
    memory_limits: dict[str, int] = field(default_factory=dict)
    commands_promised: bool = True
    """Whether the driver's commands have to arrive: not where somebody may put to the robot past every gateway."""
    neighbours_promised: bool = True
    """Whether the neighbours' messages have to come in time: not where they themselves are flooded, by who may."""
    broken: list[str] = field(default_factory=list)
    """What was not as before, in words; nothing of it is a matter of time."""

    def strictly(self) -> list[str]:
        """What does not hold of what is promised."""
        allowed = SINGLE_TIMES * self.calm.p99 if self.single else FLOOD_S
        return self._judge(max(allowed, OF_BENIGN * self.benign.p99), math.inf, STOP_S, OF_BENIGN)

    def roughly(self) -> list[str]:
        """What does not hold, whatever else the machine does."""
        p99 = max(ROUGH_P99_S, ROUGHLY_OF_BENIGN * self.benign.p99, ROUGHLY_OF_BENIGN * self.calm.p99)
        longest = max(ROUGH_LONGEST_S, 3 * self.benign.longest)
        return self._judge(p99, longest, ROUGH_STOP_S, ROUGHLY_OF_BENIGN)

    def _judge(self, p99: float, longest: float, stop: float, of_benign: float) -> list[str]:
        wrong = list(self.broken)
        if self.under.p99 > p99 and self.neighbours_promised:
            wrong.append(f"a neighbour's p99 was {ms(self.under.p99)}, allowed {ms(p99)}")
        if self.under.longest > longest and self.neighbours_promised:
            wrong.append(f"a neighbour's message took {ms(self.under.longest)}, allowed {ms(longest)}")
        for what, here, there in (
            ("a stop", self.under.stops, self.benign.stops),
            ("the dead-man's lateness", self.under.deadman, self.benign.deadman),
        ):
            allowed = max(stop, of_benign * max((t for t in there if t < math.inf), default=0.0))
            late = [took for took in here if took > allowed]
            if late:
                wrong.append(f"{len(late)} of {len(here)}: {what} took up to {ms(max(late))}, allowed {ms(allowed)}")
        if self.under.at_rest and self.commands_promised:
            wrong.append(f"{self.under.at_rest} times the driver could not get the robot to move")
        if self.under.late_commands:
            wrong.append(f"{self.under.late_commands} commands were carried out after a stop")
        for program, memory in self.memory.items():
            limit = self.memory_limits.get(program, math.inf)
            if memory.grown > limit:
                wrong.append(f"the {program} grew by {memory.grown / MIB:.0f} MiB, allowed {limit / MIB:.0f}")
        return wrong


def ms(seconds: float) -> str:
    """As people read it."""
    return "never" if seconds == math.inf else f"{seconds * 1000:.1f} ms"


HEADINGS = (
    "attack",
    "calm p99",
    "benign p99",
    "under p99",
    "longest",
    "stop p50 p99 max",
    "dead-man +max",
    "benign stop, dead-man",
    "memory",
    "",
)


def row(report: Report) -> tuple[str, ...]:
    """A line of the table."""
    under = report.under
    stops = " ".join(ms(percentile(under.stops, share)).removesuffix(" ms") for share in (0.5, 0.99, 1.0))
    grown = " ".join(
        f"{name} +{memory.grown / MIB:.0f}/{memory.kept / MIB:.0f}" for name, memory in report.memory.items()
    )
    return (
        report.name,
        ms(report.calm.p99),
        ms(report.benign.p99),
        ms(under.p99),
        ms(under.longest),
        f"{stops} ({len(under.stops)})",
        f"{ms(max(under.deadman, default=0.0))} ({len(under.deadman)})",
        f"{ms(max(report.benign.stops, default=0.0))}, {ms(max(report.benign.deadman, default=0.0))}",
        grown,
        "holds" if not report.strictly() else "FAILS",
    )


def figures(report: Report) -> dict[str, object]:
    """Everything, for programs."""

    def window(w: Window) -> dict[str, object]:
        def spread(values: Sequence[float]) -> dict[str, float | int]:
            named = {f"p{share * 100:g}": percentile(values, share) for share in (0.5, 0.9, 0.99, 1.0)}
            return {"count": len(values), **named}

        kinds = {"neighbours": w.latencies, "commands": w.commands, "stops": w.stops, "deadman": w.deadman}
        return {name: spread(values) for name, values in kinds.items()} | {"trips": w.trips, "at_rest": w.at_rest}

    return {
        "attack": report.name,
        "calm": window(report.calm),
        "benign": window(report.benign),
        "under": window(report.under),
        "memory": {name: {"grown": m.grown, "kept": m.kept} for name, m in report.memory.items()},
        "strictly": report.strictly(),
        "roughly": report.roughly(),
    }
