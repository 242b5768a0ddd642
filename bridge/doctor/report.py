"""Findings for programs, and the exit code. Pure."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import msgspec

from .checks import Severity
from .facts import Facts
from .findings import Finding, worst


def exit_code(findings: Sequence[Finding]) -> int:
    """0: nothing above a note; 1: warnings or errors."""
    return 1 if worst(findings) > Severity.NOTE else 0


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
                "remedy": finding.remedy,
            }
            for finding in findings
        ],
        "facts": msgspec.to_builtins(facts),
    }
    return json.dumps(document)
