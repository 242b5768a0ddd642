"""The tests: those that may share the machine at the same time, then a few at a time those that measure time and bear
it, then one by one those that do not.

``python -m tests.run`` is what ``make test`` runs; ``--all`` adds those that take minutes, and all
examples of those that draw their input (``make test-all``, CI);
``--fast`` is those of single modules (``make check``); with ``--backwards`` the last file comes first. A part is plain
pytest: ``make test ARGS=tests/unit``.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.support import tiers, tools
from tests.support.thorough import THOROUGH

CORES = os.cpu_count() or 1
WORKERS = min(5 * CORES, 12)
"""More than there are cores: most tests wait most of the time."""

ALL_WORKERS = min(3 * CORES, 8)
"""Beside those that take minutes: they take the cores, and with ten workers others waited for a minute."""

FEW_WORKERS = max(2, min(CORES, 3))
"""Of those that measure time, and bear some others."""

TIERS = "not chaos and not kin"


class Part(NamedTuple):
    """What came of one run of pytest."""

    good: bool
    passed: int
    failed: int
    named: list[str]
    """Its lines about what failed: the next part is minutes long."""


def part(name: str, *argv: str, workers: int = 0) -> Part:
    """Run pytest."""
    print(f"::: {name}", flush=True)
    shared = ("-n", str(workers)) if workers else ()
    process = subprocess.Popen([sys.executable, "-m", "pytest", *shared, *argv], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    closing, named = "", []
    for line in process.stdout:
        print(line, end="", flush=True)
        named += [line] if line.startswith(("FAILED ", "ERROR ")) else []
        closing = line if re.search(r"\d+ (passed|failed).* in [\d.]+s", line) else closing
    counts = {word: int(number) for number, word in re.findall(r"(\d+) (passed|failed|error)", closing)}
    good = process.wait() == 0
    return Part(good, counts.get("passed", 0), counts.get("failed", 0) + counts.get("error", 0), named)


def compile_once() -> None:
    """In a new checkout, so that not all workers do at the same time: half a minute otherwise."""
    tests = Path("tests")
    if len(list(tests.rglob(f"test_*-pytest-{pytest.__version__}.pyc"))) < len(list(tests.rglob("test_*.py"))) // 2:
        folders = {str(path.parent) for path in tests.glob("*/test_*.py")}
        collect = [sys.executable, "-m", "pytest", "--collect-only", "-qq"]
        halves = [["tests/unit"], sorted(folders - {"tests/unit"})]
        for each in [subprocess.Popen([*collect, *half], stdout=subprocess.DEVNULL) for half in halves]:
            each.wait()


def run(asked: argparse.Namespace) -> list[Part]:
    """The parts that were asked for."""
    order = ["--backwards"] if asked.backwards else []
    if asked.fast:
        return [part("fast", "tests/unit", *order, workers=max(2, CORES))]
    if asked.all:
        os.environ[THOROUGH] = "1"
    tier = TIERS if asked.all else f"{TIERS} and not soak"
    compile_once()
    workers = ALL_WORKERS if asked.all else WORKERS
    parts = [part("together", "-m", f"{tier} and not alone and not few", *order, workers=workers)]
    os.environ.pop("MACS_NEED_ROS_TESTS", None)  # judged by the first part
    parts += [part("few", *tiers.files("few"), "-m", f"{tier} and few", *order, workers=FEW_WORKERS)]
    return [*parts, part("alone", *tiers.files("alone"), "-m", f"{tier} and alone", *order)]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.run", description=__doc__, allow_abbrev=False)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--all", action="store_true", help="also those that take minutes, as CI")
    parser.add_argument("--fast", action="store_true", help="those of single modules only")
    parser.add_argument("--backwards", action="store_true", help="the last file first")
    parts = run(parser.parse_args())
    if (advice := tools.advice()) is not None:
        print(advice)
    print("".join(line for each in parts for line in each.named), end="")
    print(f"{sum(each.passed for each in parts)} passed, {sum(each.failed for each in parts)} failed")
    return 0 if all(each.good for each in parts) else 1


if __name__ == "__main__":
    sys.exit(main())
