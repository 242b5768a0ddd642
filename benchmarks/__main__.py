"""Measure, and print a table: ``python -m benchmarks [--quick] [--json | --into PAGE] [CASE ...]``.

Exit code 0: measured (missed targets are marked in the table); 1: something was lost or did not work; 2: wrong usage.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import pstats
import sys
import tempfile
import time
from contextlib import suppress
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from . import awareness, burst, cases, crowd, differing, door, peers, ports, recording, rmw, robot_speed, scale, traces
from .figures import Figure, markdown, table
from .peer_ends import KINDS
from .plan import Plan
from .processes import ProgramFailed, Stage

WITH_ROS = {**robot_speed.CASES, **awareness.CASES, **peers.CASES}
WITHOUT_ROS = {
    **cases.CASES,
    **differing.CASES,
    **scale.CASES,
    **crowd.CASES,
    **burst.CASES,
    **ports.CASES,
    **door.CASES,
    **recording.CASES,
    **traces.CASES,
    **rmw.CASES,
}
CASES = {**WITHOUT_ROS, **WITH_ROS}
ONLY_ASKED_FOR = ("burst", "mixed", "peers", "recording")
"""What takes minutes, or programs that the user starts."""
ROUNDS = 5
BEGIN, END = "<!-- figures: {} -->", "<!-- end of figures -->"
"""Around the table of a page."""


def main() -> int:
    """Run the chosen cases."""
    args = _arguments()
    plan = Plan(rounds=3, scale=0.25) if args.quick else Plan(rounds=args.rounds)
    plan.peers = dict(args.peer)
    load = [_load()]
    figures: list[Figure] = []
    failed: list[str] = []
    warnings: list[str] = []
    with tempfile.TemporaryDirectory() as profiles:
        for name in args.cases or _possible():
            began = time.monotonic()
            with Stage(Path(profiles) if args.profile else None) as stage:
                try:
                    for figure in CASES[name](stage, plan):
                        figures.append(figure)
                except ProgramFailed as error:
                    failed.append(f"{name}: {error}")
            warnings += stage.warnings()  # they say what they lost in all when they end
            print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr)
        load.append(_load())
        for profile in sorted(Path(profiles).glob("*.prof")):
            _print_profile(profile)
    report: dict[str, Any] = {
        "figures": [figure.as_json() for figure in figures],
        "delivered": plan.delivered,
        "lost": plan.lost,
        "lost_where": plan.lost_where,
        "late_where": plan.late_where,
        "failed": failed,
        "warnings": warnings,
        "machine": {"cpu": _cpu(), "cpus": os.cpu_count(), "load": load, "python": platform.python_version()},
        "versions": {name: version(name) for name in ("eclipse-zenoh", "uvloop", "msgspec")},
    }
    print(json.dumps(report, indent=1) if args.json else _text(report, figures, profiled=bool(args.profile)))
    if args.into is not None:
        _write_into(args.into, args, report, figures)
    return 1 if failed or plan.lost else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.splitlines()[0])
    what = "; ".join(f"{name}: {(case.__doc__ or '').splitlines()[0]}" for name, case in CASES.items())
    what = what.replace("%", "%%")  # argparse would fill something in
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"what to measure (default: all). {what}")
    parser.add_argument("--quick", action="store_true", help="3 rounds with a quarter of the messages or the time")
    parser.add_argument("--rounds", type=int, default=ROUNDS, metavar="N", help="rounds of each case (default: 5)")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    parser.add_argument(
        "--into", type=Path, metavar="PAGE", help="write the table into a page, where these cases were"
    )
    parser.add_argument("--peer", action="append", default=[], type=_peer, metavar="NAME=HOST:PORT", help=PEER_HELP)
    parser.add_argument("--profile", choices=["gateway"], help="run gateways under cProfile and print where time goes")
    args = parser.parse_args()
    for name in args.cases:
        if name not in CASES:
            parser.error(f"there is no case {name!r}; choose from {', '.join(CASES)}")
    if args.rounds < 1:
        parser.error("--rounds must be at least 1")
    return args


PEER_HELP = "where another program listens: ros-tcp or rosbridge (for peers)"


def _peer(text: str) -> tuple[str, str]:
    name, _, address = text.partition("=")
    host, _, port = address.rpartition(":")
    if name not in KINDS or not host or not port.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=HOST:PORT with {' or '.join(KINDS)}")
    return name, address


def _possible() -> list[str]:
    """Every case, without those for which this Python has no ROS, or this user no right."""
    if importlib.util.find_spec("rclpy") is not None:
        may_wake = os.access(robot_speed.CPU_LATENCY, os.W_OK)
        if not may_wake:
            print(f"{robot_speed.CPU_LATENCY} may not be written: robot-awake is left out", file=sys.stderr)
        left_out = ONLY_ASKED_FOR if may_wake else (*ONLY_ASKED_FOR, "robot-awake")
        return [name for name in CASES if name not in left_out]
    print(f"no rclpy: {', '.join(WITH_ROS)} are left out", file=sys.stderr)
    return [name for name in WITHOUT_ROS if name not in ONLY_ASKED_FOR]


def _write_into(page: Path, args: argparse.Namespace, report: dict[str, Any], figures: list[Figure]) -> None:
    """Write a table between the marks of these cases, or behind everything. It says how much was measured."""
    names = " ".join(args.cases)
    text, begin = page.read_text(), BEGIN.format(names)
    how = " --quick" if args.quick else f" --rounds {args.rounds}" if args.rounds != ROUNDS else ""
    said = f"`python -m benchmarks{how} {names}`: {_losses(report)}"
    lines = [begin, f"{date.today()}, {_machine(report)}", "", said]
    table = "\n".join([*lines, "", markdown(figures), END])
    before, found, after = text.partition(begin)
    after = after.partition(END)[2] if found else ""
    page.write_text(f"{before if found else before + chr(10)}{table}{after or chr(10)}")


def _machine(report: dict[str, Any]) -> str:
    machine = report["machine"]
    loads = ", ".join(f"{load:.2f}" for load in machine["load"])
    versions = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    return (
        f"machine: {machine['cpu']}, {machine['cpus']} CPUs, load {loads} (before, after), "
        f"Python {machine['python']}, {versions}"
    )


def _losses(report: dict[str, Any]) -> str:
    return f"lost: {report['lost']} of {report['delivered'] + report['lost']} messages"


def _cpu() -> str:
    """What the processor is called."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.machine()


def _text(report: dict[str, Any], figures: list[Figure], *, profiled: bool) -> str:
    lines = [
        table(figures),
        "",
        _losses(report),
        *(f"  lost on {where}" for where in report["lost_where"]),
        *(f"  late on {where}" for where in report["late_where"]),
        *(report["warnings"] if report["lost"] or report["failed"] else ()),
        _machine(report),
        *(f"failed: {failure}" for failure in report["failed"]),
    ]
    if profiled:
        lines.append("The gateways ran under a profiler: these ratios mean nothing.")
    return "\n".join(lines)


def _print_profile(path: Path) -> None:
    print(f"== {path.stem}", file=sys.stderr)
    pstats.Stats(str(path), stream=sys.stderr).sort_stats("tottime").print_stats(30)


def _load() -> float:
    return os.getloadavg()[0]


if __name__ == "__main__":
    sys.exit(main())
