"""Recordings as Foxglove and Lichtblick open them: by the packages from npm that both read files with."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.support.browser import ROOT, node

PACKAGES = ROOT / "build" / "npm"
THERE = node() is not None and (PACKAGES / "node_modules" / "@mcap" / "core").is_dir()
needs_lichtblick = pytest.mark.skipif(not THERE, reason="what Lichtblick reads files with is missing: make page")


def lichtblick(path: Path) -> dict[str, Any]:
    """What is in a file, each message of it decoded: ``profile``, ``statistics`` and by topic ``channels``, with the
    ``type``, the ``count`` and the ``first`` and ``last`` message of each."""
    command = [*(node() or []), Path(__file__).with_suffix(".mjs"), PACKAGES, path]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found
