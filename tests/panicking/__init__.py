"""Programs whose Zenoh panics, a real panic."""

from __future__ import annotations

import os
from pathlib import Path

from tests.support.processes import ROOT


def panicking(where: str, when: Path | None = None) -> dict[str, str]:
    """The environment of a program whose Zenoh panics: 2 s after it joined, or as soon as there is a file."""
    path = os.pathsep.join([str(ROOT / "tests" / "panicking"), str(ROOT), os.environ.get("PYTHONPATH", "")])
    moment = {"MACS_TEST_PANIC_WHEN": str(when)} if when is not None else {}
    return {"PYTHONPATH": path, "MACS_TEST_PANIC": where, **moment}
