"""What a run has measured, and the table of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any


@dataclass(frozen=True)
class Figure:
    """One line: a subject against its baseline, each the values of all rounds in order.

    ``at_least`` or ``at_most`` bounds the ratio of the medians; a line without a bound only informs.
    """

    name: str
    subject: list[float]
    baseline: list[float]
    against: str
    unit: str
    at_least: float | None = None
    at_most: float | None = None
    column: str = ""
    """Lines of one name and several columns stand side by side on a page."""

    @property
    def value(self) -> float:
        """The subject's median."""
        return median(self.subject)

    @property
    def reference(self) -> float:
        """The baseline's median."""
        return median(self.baseline)

    @property
    def ratio(self) -> float:
        """Median over median."""
        return self.value / self.reference if self.reference else math.nan

    @property
    def spread(self) -> tuple[float, float]:
        """The lowest and the highest ratio of one round."""
        pairs = zip(self.subject, self.baseline, strict=True)
        ratios = [ours / theirs for ours, theirs in pairs if theirs and math.isfinite(theirs)]
        return min(ratios, default=math.nan), max(ratios, default=math.nan)

    @property
    def target(self) -> str:
        """The bound in words."""
        if self.at_least is not None:
            return f">= {self.at_least:g}"
        return f"<= {self.at_most:g}" if self.at_most is not None else ""

    @property
    def met(self) -> bool | None:
        """Whether the bound holds; None without one."""
        if self.at_least is not None:
            return self.ratio >= self.at_least
        return self.ratio <= self.at_most if self.at_most is not None else None

    def as_json(self) -> dict[str, Any]:
        """The line for programs."""
        return {
            "name": self.name,
            "column": self.column,
            "unit": self.unit,
            "value": self.value,
            "against": self.against,
            "baseline": self.reference,
            "ratio": self.ratio,
            "ratios": list(self.spread),
            "target": self.target,
            "met": self.met,
            "rounds": len(self.subject),
        }


COLUMNS = ("figure", "value", "baseline", "", "unit", "ratio", "(rounds)", "target", "")


def table(figures: Sequence[Figure]) -> str:
    """All lines, columns aligned."""
    rows = [COLUMNS, *(_row(figure) for figure in figures)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(COLUMNS))]
    right = {1, 2, 5}
    return "\n".join(
        "  ".join(cell.rjust(width) if i in right else cell.ljust(width) for i, (cell, width) in columns).rstrip()
        for columns in (list(enumerate(zip(row, widths, strict=True))) for row in rows)
    )


def markdown(figures: Sequence[Figure]) -> str:
    """The same as tables of a page."""
    plain = [figure for figure in figures if not figure.column]
    beside = [figure for figure in figures if figure.column]
    return "\n\n".join([*([_plain(plain)] if plain else []), *([_side_by_side(beside)] if beside else [])])


def _side_by_side(figures: Sequence[Figure]) -> str:
    columns = list(dict.fromkeys(figure.column for figure in figures))
    cells = {(figure.name, figure.column): f"{_number(figure.value)} {figure.unit}" for figure in figures}
    rows = [["", *columns], ["---", *("---:" for _ in columns)]]
    for name in dict.fromkeys(figure.name for figure in figures):
        rows.append([name, *(cells.get((name, column), "") for column in columns)])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _plain(figures: Sequence[Figure]) -> str:
    rows = [("figure", "value", "against", "ratio", "rounds", "goal"), ("---", "---:", "---", "---:", "---", "---")]
    for figure in figures:
        name, value, baseline, against, unit, ratio, rounds, target, verdict = _row(figure)
        rows.append(
            (name, f"{value} {unit}", f"{baseline} {against}", ratio, rounds.strip("()"), f"{target} {verdict}")
        )
    return "\n".join("| " + " | ".join(cell.strip() for cell in row) + " |" for row in rows)


def _row(figure: Figure) -> tuple[str, ...]:
    low, high = figure.spread
    verdict = {None: "", True: "ok", False: "MISSED"}[figure.met]
    return (
        f"{figure.column}, {figure.name}" if figure.column else figure.name,
        _number(figure.value),
        _number(figure.reference),
        figure.against,
        figure.unit,
        f"{figure.ratio:.2f}",
        f"({low:.2f}-{high:.2f})",
        figure.target,
        verdict,
    )


def _number(value: float) -> str:
    return f"{value:,.0f}".replace(",", " ") if value >= 100 else f"{value:.3g}"
