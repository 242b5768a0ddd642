"""Every test: those that may share the machine at the same time, then one by one those that measure time.

``python -m tests.run`` is what ``make test`` runs. A part of the tests is plain pytest: ``make test ARGS=tests/unit``.
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
    together = part("together", "-n", str(WORKERS), "--dist", "loadfile", "-m", f"{TIERS} and not alone")
    os.environ.pop("MACS_NEED_ROS_TESTS", None)  # judged by the first part
    alone = part("alone", "-m", f"{TIERS} and alone")
    print(f"{together[1] + alone[1]} passed, {together[2] + alone[2]} failed")
    return 0 if together[0] and alone[0] else 1


if __name__ == "__main__":
    sys.exit(main())
