"""Figures by name, each with a few labels, and never more of them than a monitoring system should be given. Pure."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

Kind = Literal["counter", "gauge", "info"]
Labels = tuple[tuple[str, str], ...]

MOST_ROWS = 30
"""Of one figure: what is more than this is added up under `OTHERS`."""
MOST_TYPES = 8
"""Of kinds of agents, of which there are three, and 255 that there may be."""
OTHERS = "(others)"


@dataclass
class Family:
    """One figure: its name without a unit of Prometheus' own endings, and a value for each of its labels' values."""

    name: str
    kind: Kind
    help: str
    rows: dict[Labels, float] = field(default_factory=dict)

    def add(self, value: float, **labels: str) -> Family:
        """One more value, added to what these labels have already."""
        key = tuple(sorted(labels.items()))
        self.rows[key] = self.rows.get(key, 0) + value
        return self

    def bounded(self, most: int = MOST_ROWS) -> Family:
        """The same with at most so many rows: the largest ones, and the sum of all others."""
        if len(self.rows) <= most:
            return self
        ordered = sorted(self.rows.items(), key=lambda row: -row[1])
        kept = Family(self.name, self.kind, self.help, dict(ordered[: most - 1]))
        names = [name for name, _ in ordered[0][0]]
        rest = sum(value for _, value in ordered[most - 1 :])
        return kept.add(rest, **dict.fromkeys(names, OTHERS))


@dataclass
class Histogram:
    """How often something was within which bound; of each hop the numbers in each bucket, and their sum."""

    name: str
    help: str
    bounds: tuple[float, ...]
    rows: dict[str, tuple[list[int], float]] = field(default_factory=dict)


def counter(name: str, text: str) -> Family:
    """What only grows."""
    return Family(name, "counter", text)


def gauge(name: str, text: str) -> Family:
    """What is so now."""
    return Family(name, "gauge", text)


def build(program: str, versions: Mapping[str, str]) -> Family:
    """Which program this is, and of which versions."""
    python = ".".join(map(str, sys.version_info[:3]))
    labels = {"program": program, "python": python, **{name: text or "?" for name, text in versions.items()}}
    return Family("macs_build", "info", "program and versions").add(1, **labels)


def drops(counts: Mapping[str, Mapping[str, int]]) -> Family:
    """What was lost, by where and by the name of its counter (docs/counters.md)."""
    family = counter("macs_drops", "what was lost, by where it was and the name of its counter")
    for where, names in counts.items():
        for name, count in names.items():
            family.add(count, where=where, counter=name)
    return family.bounded()


def by_type(name: str, text: str, kinds: Iterable[str]) -> Family:
    """How many of each kind there are."""
    family = gauge(name, text)
    for kind, count in sorted(Counter(kinds).items()):
        family.add(count, type=kind)
    return family.bounded(MOST_TYPES)
