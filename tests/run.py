"""The tests: those that may share the machine at the same time, then one by one those that measure time.

``python -m tests.run`` is what ``make test`` runs; ``--all`` adds those that take minutes, and all
examples of those that draw their input (``make test-all``, CI);
``--fast`` is those of single modules (``make check``); with ``--backwards`` the last file comes first. A part is plain
pytest: ``make test ARGS=tests/unit``.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys

from tests.support import tools
from tests.support.thorough import THOROUGH

CORES = os.cpu_count() or 1
WORKERS = min(4 * CORES, 12)
"""More than there are cores: most tests wait most of the time."""

TIERS = "not chaos and not kin"


def part(name: str, *argv: str, workers: int = 0) -> tuple[bool, int, int]:
    """Run pytest; whether it went well, and how many tests passed and failed."""
    print(f"::: {name}", flush=True)
    shared = ("-n", str(workers), "--dist", "worksteal") if workers else ()
    process = subprocess.Popen([sys.executable, "-m", "pytest", *shared, *argv], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    closing = ""
    for line in process.stdout:
        print(line, end="", flush=True)
        closing = line if re.search(r"\d+ (passed|failed).* in [\d.]+s", line) else closing
    counts = {word: int(number) for number, word in re.findall(r"(\d+) (passed|failed|error)", closing)}
    good = process.wait() == 0
    return good, counts.get("passed", 0), counts.get("failed", 0) + counts.get("error", 0)


def run(words: list[str]) -> list[tuple[bool, int, int]]:
    """The parts that were asked for."""
    order = ["--backwards"] if "--backwards" in words else []
    if "--fast" in words:
        return [part("fast", "tests/unit", *order, workers=max(2, CORES))]
    if "--all" in words:
        os.environ[THOROUGH] = "1"
    tiers = TIERS if "--all" in words else f"{TIERS} and not soak"
    parts = [part("together", "-m", f"{tiers} and not alone", *order, workers=WORKERS)]
    os.environ.pop("MACS_NEED_ROS_TESTS", None)  # judged by the first part
    return [*parts, part("alone", "-m", f"{tiers} and alone", *order)]


def main() -> int:
    parts = run(sys.argv[1:])
    if (advice := tools.advice()) is not None:
        print(advice)
    print(f"{sum(passed for _, passed, _ in parts)} passed, {sum(failed for *_, failed in parts)} failed")
    return 0 if all(good for good, *_ in parts) else 1


if __name__ == "__main__":
    sys.exit(main())
