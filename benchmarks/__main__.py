"""Measure, and print a table: ``python -m benchmarks [--quick] [--json] [CASE ...]``.

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
from importlib.metadata import version
from pathlib import Path
from typing import Any

from . import awareness, cases, differing, robot_speed, scale
from .figures import Figure, table
from .plan import Plan
from .processes import ProgramFailed, Stage

WITH_ROS = {**robot_speed.CASES, **awareness.CASES}
WITHOUT_ROS = {**cases.CASES, **differing.CASES, **scale.CASES}
CASES = {**WITHOUT_ROS, **WITH_ROS}


def main() -> int:
    """Run the chosen cases."""
    args = _arguments()
    plan = Plan(rounds=3, scale=0.25) if args.quick else Plan(rounds=args.rounds)
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
                warnings += stage.warnings()
            print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr)
        load.append(_load())
        for profile in sorted(Path(profiles).glob("*.prof")):
            _print_profile(profile)
    report: dict[str, Any] = {
        "figures": [figure.as_json() for figure in figures],
        "delivered": plan.delivered,
        "lost": plan.lost,
        "lost_where": plan.lost_where,
        "failed": failed,
        "warnings": warnings,
        "machine": {"cpus": os.cpu_count(), "load": load, "python": platform.python_version()},
        "versions": {name: version(name) for name in ("eclipse-zenoh", "uvloop", "msgspec")},
    }
    print(json.dumps(report, indent=1) if args.json else _text(report, figures, profiled=bool(args.profile)))
    return 1 if failed or plan.lost else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.splitlines()[0])
    what = "; ".join(f"{name}: {(case.__doc__ or '').splitlines()[0]}" for name, case in CASES.items())
    what = what.replace("%", "%%")  # argparse would fill something in
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"what to measure (default: all). {what}")
    parser.add_argument("--quick", action="store_true", help="3 rounds with a quarter of the messages or the time")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="rounds of each case (default: 5)")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    parser.add_argument("--profile", choices=["gateway"], help="run gateways under cProfile and print where time goes")
    args = parser.parse_args()
    for name in args.cases:
        if name not in CASES:
            parser.error(f"there is no case {name!r}; choose from {', '.join(CASES)}")
    if args.rounds < 1:
        parser.error("--rounds must be at least 1")
    return args


def _possible() -> list[str]:
    """Every case, without those for which this Python has no ROS, or this user no right."""
    if importlib.util.find_spec("rclpy") is not None:
        may_wake = os.access(robot_speed.CPU_LATENCY, os.W_OK)
        if not may_wake:
            print(f"{robot_speed.CPU_LATENCY} may not be written: robot-awake is left out", file=sys.stderr)
        return [name for name in CASES if may_wake or name != "robot-awake"]
    print(f"no rclpy: {', '.join(WITH_ROS)} are left out", file=sys.stderr)
    return list(WITHOUT_ROS)


def _text(report: dict[str, Any], figures: list[Figure], *, profiled: bool) -> str:
    machine = report["machine"]
    loads = ", ".join(f"{load:.2f}" for load in machine["load"])
    versions = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    lines = [
        table(figures),
        "",
        f"lost: {report['lost']} of {report['delivered'] + report['lost']} messages",
        *(f"  lost on {where}" for where in report["lost_where"]),
        *(report["warnings"] if report["lost"] or report["failed"] else ()),
        f"machine: {machine['cpus']} CPUs, load {loads} (before, after), Python {machine['python']}, {versions}",
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
