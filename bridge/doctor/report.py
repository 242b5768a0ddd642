"""Findings for people and for programs. Pure."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import msgspec

from macs_zenoh.plain import plain

from .facts import Facts
from .findings import Finding, worst
from .kinds import OK, Severity

TITLES = {
    "routers": "Routers",
    "tls": "TLS",
    "access": "Access",
    "mesh": "Who is there",
    "programs": "Programs, clocks",
    "settings": "These settings",
}
SIGNS = {Severity.OK: "ok", Severity.NOTE: "note", Severity.WARNING: "warning", Severity.ERROR: "ERROR"}
COLOURS = {Severity.OK: "32", Severity.NOTE: "36", Severity.WARNING: "33", Severity.ERROR: "31;1"}
SIGN_WIDTH = max(map(len, SIGNS.values()))
WIDTH = 118

EXIT_CODES = {Severity.OK: 0, Severity.NOTE: 0, Severity.WARNING: 1, Severity.ERROR: 3}
"""2 is wrong usage, as with every verb."""


def exit_code(findings: Sequence[Finding]) -> int:
    """0: nothing above a note; 1: warnings; 3: errors."""
    return EXIT_CODES[worst(findings)]


def as_json(findings: Sequence[Finding], facts: Facts) -> str:
    """One object: severity, findings, and the facts behind them."""
    document: dict[str, Any] = {
        "severity": worst(findings).name.lower(),
        "findings": [
            {
                "id": finding.id,
                "group": finding.group,
                "severity": finding.severity.name.lower(),
                "where": finding.where,
                "what": finding.text,
                "todo": finding.todo,
            }
            for finding in findings
        ],
        "facts": msgspec.to_builtins(facts),
    }
    return json.dumps(document)


def as_text(findings: Sequence[Finding], facts: Facts, *, colours: bool) -> str:
    """Groups of findings, each with where it is, what it is and what to do, and a last line that sums up."""
    lines: list[str] = []
    for group, members in groupby(findings, key=lambda finding: finding.group):
        lines += ["", _coloured(TITLES[group], "1", colours)]
        for finding in members:
            lines += _finding(finding, colours)
    return "\n".join([*lines[1:], "", _summary(findings, facts)])


def _finding(finding: Finding, colours: bool) -> list[str]:
    sign = _coloured(f"{SIGNS[finding.severity]:<{SIGN_WIDTH}}", COLOURS[finding.severity], colours)
    indent = " " * (SIGN_WIDTH + 4)
    text = f"{finding.where}: {finding.text}" if finding.where else finding.text
    what = _wrapped(text, indent)
    todo = _wrapped("→ " + finding.todo, indent) if finding.todo and finding.severity != OK else []
    return [f"  {sign}  {what[0].strip()}", *what[1:], *todo]


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(
        plain(text.replace("\n", " ")),
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent,
        break_on_hyphens=False,
        break_long_words=False,
    )


def _coloured(text: str, code: str, colours: bool) -> str:
    return f"\033[{code}m{text}\033[0m" if colours else text


def _summary(findings: Sequence[Finding], facts: Facts) -> str:
    counts = {severity: sum(finding.severity == severity for finding in findings) for severity in Severity}
    words = [
        f"{counts[severity]} {name}{'' if counts[severity] == 1 else 's'}"
        for severity, name in ((Severity.ERROR, "error"), (Severity.WARNING, "warning"), (Severity.NOTE, "note"))
        if counts[severity]
    ]
    measured = f"; measured with {facts.probe_bytes / 1e6:.1f} MB" if facts.probe_bytes else ""
    return (", ".join(words) or "nothing is wrong") + measured
