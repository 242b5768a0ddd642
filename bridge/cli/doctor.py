"""Examine a mesh from this machine: what is wrong, where, and what to do about it.

Give it the settings of the program that has trouble: each router endpoint is tried by itself (TCP, TLS, Zenoh), and
what access rules forbid in silence is found by trying, with this program's own credentials. Also: versions, clocks,
round trips and throughput, blocks and ids taken twice, routers that are not linked. docs/doctor.md explains each
finding.

Exit code by severity: 0 nothing above a note, 1 warnings, 3 errors, 2 wrong usage or configuration.

examples:
  macs doctor
  macs doctor -e tcp/192.168.1.10:7447 -e tcp/192.168.1.11:7447
  macs doctor --settings gateway-1.toml                 with the gateway's certificate, and its rights
  macs doctor --settings robot.toml --as ros/7 --quick
  macs doctor --json | jq '.findings[] | select(.severity == "error")'"""

from __future__ import annotations

import argparse
import logging
import sys

from bridge.cli import options, output, running
from macs_zenoh.errors import UsageError
from macs_zenoh.versions import installed

SUMMARY = "what is wrong with a mesh, and what to do"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="for programs: {severity, findings, facts}")
    parser.add_argument(
        "--quick", action="store_true", help="no throughput: leaves out the echoes of up to 1 MiB, 2.8 MB per way"
    )
    parser.add_argument(
        "--timeout", type=float, default=3.0, metavar="S", help="how long each single step may take (default: 3)"
    )
    parser.add_argument(
        "--as",
        dest="who",
        metavar="WHO",
        help="whose rights to try: ros/7, gateway/1 (its block), operator/5, observer (default: as the settings say)",
    )
    options.add_mesh_options(parser, modes=())


def run(args: argparse.Namespace) -> int:
    from bridge.doctor import report
    from bridge.doctor.findings import judge
    from bridge.doctor.look import Examination, Who

    if args.timeout <= 0:
        raise UsageError(f"--timeout is {args.timeout:g}, more than 0 is needed")
    if not args.verbose:
        logging.getLogger("macs").setLevel(logging.WARNING)  # each session would tell of its router
    settings = options.settings(args)
    who = Who.parse(args.who, settings.robot.group) if args.who else Who.of(settings)
    examination = Examination(
        settings,
        who=who,
        timeout_s=args.timeout,
        quick=args.quick,
        versions=(installed("macs-zenoh"), installed("eclipse-zenoh")),
        on_progress=_progress,
    )

    async def examine() -> int:
        facts = await examination.run()
        _progress("")
        findings = judge(facts)
        in_colour = sys.stdout.isatty()
        text = report.as_json(findings, facts) if args.json else report.as_text(findings, facts, colours=in_colour)
        output.say(text, coloured=in_colour and not args.json)
        return report.exit_code(findings)

    return running.until_stopped(examine, interrupted=running.INTERRUPTED)


def _progress(text: str) -> None:
    """Say on a terminal what is being done, in one line that is written over; nothing on a pipe."""
    output.note_progress(f"\r\033[K{text[:100]}")
