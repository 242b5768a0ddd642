"""What became of the checks, for people and for programs. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from xml.etree import ElementTree

from macs_zenoh.plain import plain

from .checks import Check, Level, Outcome, Verdict


def as_lines(verdicts: Sequence[Verdict], *, every: bool = False) -> list[str]:
    """One line for each check that did not pass, or for ``every`` one, and how many there were of each."""
    lines = []
    for check, outcome, why in verdicts:
        if every or outcome is Outcome.FAILED:
            lines.append(f"{outcome.value:7} {check.name}: {check.about}")
            if why:
                lines.append(f"        {plain(why)}")
            if check.deafens_existing and outcome is Outcome.FAILED:
                lines.append("        the existing headset goes deaf there as well: routers must not send it")
    counted = Counter(verdict.outcome for verdict in verdicts)
    lines.append(", ".join(f"{counted[outcome]} {outcome.value}" for outcome in Outcome))
    return lines


def as_data(program: str, level: Level, verdicts: Sequence[Verdict], seconds: float) -> dict[str, object]:
    """All of it, for ``--json``."""
    counted = Counter(verdict.outcome.value for verdict in verdicts)
    return {
        "program": program,
        "level": level.value,
        "seconds": round(seconds, 1),
        **{outcome.value: counted[outcome.value] for outcome in Outcome},
        "checks": [
            {**described(verdict.check), "outcome": verdict.outcome.value, "why": verdict.why} for verdict in verdicts
        ],
    }


def described(check: Check) -> dict[str, object]:
    """A check, for ``--list --json``."""
    return {
        "name": check.name,
        "about": check.about,
        "level": check.level.value,
        "deafens_existing": check.deafens_existing,
    }


def as_junit(program: str, level: Level, verdicts: Sequence[Verdict], seconds: float) -> str:
    """JUnit's XML, as CI systems show it: one test case for each check, its class the part before the dot."""
    counted = Counter(verdict.outcome for verdict in verdicts)
    suite = ElementTree.Element(
        "testsuite",
        name=f"macs conformance {program} ({level.value})",
        tests=str(len(verdicts)),
        failures=str(counted[Outcome.FAILED]),
        skipped=str(counted[Outcome.SKIPPED]),
        errors="0",
        time=f"{seconds:.1f}",
    )
    for check, outcome, why in verdicts:
        section, _, _ = check.name.partition(".")
        case = ElementTree.SubElement(suite, "testcase", classname=f"{program}.{section}", name=check.name, time="0")
        if outcome is Outcome.FAILED:
            ElementTree.SubElement(case, "failure", message=plain(why)).text = check.about
        elif outcome is Outcome.SKIPPED:
            ElementTree.SubElement(case, "skipped", message=plain(why))
    ElementTree.indent(suite)
    return ElementTree.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def list_lines(checks: Iterable[Check]) -> list[str]:
    """The checks themselves, for ``--list``."""
    return [f"{check.name:38} {check.level.value:10} {check.about}" for check in checks]
