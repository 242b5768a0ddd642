"""What was found: its id, how bad it is, where, what was seen and what to do. Pure.

The table of all that can be is in `checks`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from .checks import CHECKS, OK, Severity


class Finding(NamedTuple):
    """One thing that was found."""

    id: str
    severity: Severity
    where: str
    text: str
    remedy: str

    @property
    def group(self) -> str:
        """The part of the report that it belongs to."""
        return CHECKS[self.id].group


def found(finding: str, where: str = "", *, severity: Severity | None = None, **values: object) -> Finding:
    """A finding of a kind, filled in."""
    kind = CHECKS[finding]
    return Finding(
        finding,
        kind.severity if severity is None else severity,
        where,
        kind.text.format(**values),
        kind.remedy.format(**values),
    )


def worst(findings: Iterable[Finding]) -> Severity:
    """The severity of the whole."""
    return max((finding.severity for finding in findings), default=OK)
