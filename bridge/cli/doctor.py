"""Examine a mesh from this machine: what is wrong, where, and what to do about it.

Give it the settings of the program that has trouble: each router endpoint is tried by itself (TCP, TLS, Zenoh), and
what access rules forbid in silence is found by trying, with this program's own credentials. Also: versions, clocks,
round trips and throughput, blocks and ids taken twice, routers that are not linked. docs/doctor.md explains each
finding.

Exit code 0: nothing above a note; 1: warnings or errors, --json says how bad; 2: wrong usage or configuration; 130:
Ctrl-C.

examples:
  macs doctor
  macs doctor -e tcp/192.168.1.10:7447 -e tcp/192.168.1.11:7447
  macs doctor --settings gateway-1.toml                 with the gateway's certificate, and its rights
  macs doctor --settings robot.toml --as ros/7 --quick
  macs doctor --json | jq '.findings[] | select(.severity == "error")'

what it prints:
  Routers
    ok       tcp/10.0.0.1:7447: Zenoh 1.10.2, 0.9 ms there and back, about 330 Mbit/s
    warning  tcp/10.0.0.2:7447: nobody listens there
             → start the router there, or correct host and port

  1 warning; measured with 2.8 MB"""

from __future__ import annotations

import argparse
import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import TYPE_CHECKING

from bridge.cli import options, output, running, terminal
from bridge.cli.terminal import BAD, HEADING, ODD, Block, Cell, Columns
from bridge.principal import Principal
from macs_zenoh.errors import UsageError
from macs_zenoh.versions import installed

if TYPE_CHECKING:
    from bridge.doctor.facts import Facts
    from bridge.doctor.findings import Finding

SUMMARY = "what is wrong with a mesh, and what to do"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="for programs: {severity, findings, facts}")
    parser.add_argument(
        "--quick", action="store_true", help="no throughput: leaves out the echoes of up to 1 MiB, 2.8 MB per way"
    )
    parser.add_argument(
        "--timeout", type=float, default=3.0, metavar="S", help="how long each single step may take (default: 3)"
    )
    options.add_as_option(parser)
    options.add_mesh_options(parser, modes=())


def run(args: argparse.Namespace) -> int:
    from bridge.doctor import report
    from bridge.doctor.analyze import analyze
    from bridge.doctor.gather import Probe

    if args.timeout <= 0:
        raise UsageError(f"--timeout is {args.timeout:g}, more than 0 is needed")
    if not args.verbose:
        logging.getLogger("macs").setLevel(logging.WARNING)  # each session would tell of its router
    settings = options.settings(args)
    told: Principal | None = args.principal
    principal = replace(told, group=settings.robot.group) if told else Principal.of(settings)

    async def examine() -> int:
        with terminal.progress() as tell:
            facts = await Probe(
                settings,
                principal=principal,
                timeout_s=args.timeout,
                quick=args.quick,
                versions=(installed("macs-zenoh"), installed("eclipse-zenoh")),
                on_progress=lambda step: tell(step, 0, 0),
            ).run()
        findings = analyze(facts)
        if args.json:
            output.say(report.as_json(findings, facts))
        else:
            terminal.show(*shown(findings, facts))
        return report.exit_code(findings)

    return running.until_stopped(examine, interrupted=running.INTERRUPTED)


TITLES = {
    "routers": "Routers",
    "tls": "TLS",
    "access": "Access",
    "mesh": "Who is there",
    "programs": "Programs, clocks",
    "settings": "These settings",
}
SIGNS = {"OK": ("ok", "green"), "NOTE": ("note", "cyan"), "WARNING": ("warning", ODD), "ERROR": ("ERROR", BAD)}
SIGN_WIDTH = max(len(sign) for sign, _ in SIGNS.values())


def shown(findings: Sequence[Finding], facts: Facts) -> Iterator[Block]:
    """Groups of findings, each with where it is, what it is and what to do, and a last line that sums up."""
    for number, (group, members) in enumerate(groupby(findings, key=lambda finding: finding.group)):
        if number:
            yield ""
        yield TITLES[group], HEADING
        yield Columns([row for finding in members for row in _rows(finding)], indent=2)
    yield ""
    yield _summary(findings, facts)


def _rows(finding: Finding) -> Iterator[tuple[Cell, Cell]]:
    sign, style = SIGNS[finding.severity.name]
    text = f"{finding.where}: {finding.text}" if finding.where else finding.text
    yield (f"{sign:<{SIGN_WIDTH}}", style), _one_line(text)
    if finding.remedy and finding.severity.name != "OK":
        yield "", "→ " + _one_line(finding.remedy)


def _one_line(text: str) -> str:
    return text.replace("\n", " ")


def _summary(findings: Sequence[Finding], facts: Facts) -> str:
    counts = Counter(finding.severity.name.lower() for finding in findings)
    words = [
        f"{counts[name]} {name}{'' if counts[name] == 1 else 's'}"
        for name in ("error", "warning", "note")
        if counts[name]
    ]
    measured = f"; measured with {facts.probe_bytes / 1e6:.1f} MB" if facts.probe_bytes else ""
    return (", ".join(words) or "nothing is wrong") + measured
