"""Attack, and print a table: ``python -m tests.attack [OPTIONS] [NAME ...]``.

Exit code 0: everything held; 1: something did not; 2: wrong usage.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import random
import sys
import tempfile
import time
from pathlib import Path

from tests.attack import judge, table
from tests.attack.scene import scene
from tests.attack.ways import WAYS, Way


async def run(rows: list[table.Attack], options: argparse.Namespace) -> list[judge.Report]:
    """Each attack, in one scene as long as everything is as before after it, and it is one of the kind."""
    reports: list[judge.Report] = []

    def kind(row: table.Attack) -> tuple[bool, Way]:
        return row.certified, row.way or options.way

    waiting = sorted(rows, key=kind)
    while waiting:
        with tempfile.TemporaryDirectory() as directory:
            certified, way = wanted = kind(waiting[0])
            made = scene(Path(directory), random.randint(1, 100), certified=certified, way=way)
            async with made as stage:
                while waiting and kind(waiting[0]) == wanted:
                    row = waiting.pop(0)
                    began = time.monotonic()
                    try:
                        report = await stage.suffer(row, seconds=options.seconds, stops=options.stops)
                    except Exception as error:  # noqa: BLE001 - the scene did not survive: the next attack gets a new one
                        nothing = judge.Window()
                        report = judge.Report(row.name, row.single, nothing, nothing, nothing, broken=[repr(error)])
                    reports.append(report)
                    print("  ".join(judge.row(report)), f"({time.monotonic() - began:.0f} s)", flush=True)
                    for problem in report.strictly():
                        print(f"    {problem}", flush=True)
                    if report.roughly():
                        print("    FAILS ROUGHLY, on whatever machine", flush=True)
                    if report.broken:
                        break
    return reports


def main() -> int:
    """From the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.attack", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="attacks, or how their names begin (default: all)")
    parser.add_argument("--list", action="store_true", help="name them, and say what each sends")
    parser.add_argument("--section", type=int, action="append", help="those that look for faults of this class")
    parser.add_argument("--seen", action="store_true", help="those with which something was once brought down")
    parser.add_argument("--seconds", type=float, default=4.0, help="how long each lasts (default: 4)")
    parser.add_argument("--stops", type=int, help="go on until so many stops were pressed")
    parser.add_argument("--way", choices=WAYS, default="tcp", help="how TCP agents that attack come in (default: tcp)")
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    options = parser.parse_args()
    rows = [
        row
        for row in table.every().values()
        if (not options.names or any(row.name.startswith(name) for name in options.names))
        and (not options.section or row.section in options.section)
        and (not options.seen or row.seen)
    ]
    if not rows:
        parser.error("there is no such attack; --list names them")
    if options.list:
        for row in rows:
            print(f"{row.section} {row.by:9} {'single' if row.single else 'flood ':6} {row.name}: {row.says}")
        return 0
    logging.getLogger("macs").setLevel(logging.ERROR)  # the headsets here are told of every stop
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print("  ".join(judge.HEADINGS))
    reports = asyncio.run(run(rows, options))
    failed = [report.name for report in reports if report.strictly()]
    print(f"{len(reports) - len(failed)} of {len(reports)} hold; load {os.getloadavg()[0]:.1f}")
    if options.json:
        options.json.write_text(json.dumps([judge.figures(report) for report in reports], indent=1))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
