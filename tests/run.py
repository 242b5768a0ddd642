"""The tests: those that may share the machine at the same time, then one by one those that measure time.

``python -m tests.run`` is what ``make test`` runs; with ``--all`` those that take minutes too (``make test-all``, CI).
A part of the tests is plain pytest: ``make test ARGS=tests/unit``.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys

WORKERS = 4
"""More than this machine may have cores: most tests wait most of the time."""

TIERS = "not chaos and not kin"


def part(name: str, *argv: str) -> tuple[bool, int, int]:
    """Run pytest; whether it went well, and how many tests passed and failed."""
    print(f"::: {name}", flush=True)
    process = subprocess.Popen([sys.executable, "-m", "pytest", *argv], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    closing = ""
    for line in process.stdout:
        print(line, end="", flush=True)
        closing = line if re.search(r"\d+ (passed|failed).* in [\d.]+s", line) else closing
    counts = {word: int(number) for number, word in re.findall(r"(\d+) (passed|failed|error)", closing)}
    good = process.wait() == 0
    return good, counts.get("passed", 0), counts.get("failed", 0) + counts.get("error", 0)


def main() -> int:
    tiers = TIERS if "--all" in sys.argv[1:] else f"{TIERS} and not soak"
    parts = [part("together", "-n", str(WORKERS), "--dist", "loadfile", "-m", f"{tiers} and not alone")]
    os.environ.pop("MACS_NEED_ROS_TESTS", None)  # judged by the first part
    parts.append(part("alone", "-m", f"{tiers} and alone"))
    print(f"{sum(passed for _, passed, _ in parts)} passed, {sum(failed for *_, failed in parts)} failed")
    return 0 if all(good for good, *_ in parts) else 1


if __name__ == "__main__":
    sys.exit(main())
