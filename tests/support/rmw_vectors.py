"""What was recorded of the real rmw_zenoh (rmw_zenoh_cpp 0.2.10, Jazzy), and golden lines that others publish."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

VECTORS = Path(__file__).parents[1] / "rmw_vectors"
TOKEN = "@ros2_lv/"
CRATE, CRATE_VERSION = "hiroz-protocol", "0.2.1"


@cache
def rows(name: str) -> list[dict[str, Any]]:
    """The rows of one recording."""
    found: list[dict[str, Any]] = json.loads((VECTORS / f"{name}.json").read_text(encoding="utf-8"))["rows"]
    return found


def all_rows() -> Iterator[tuple[str, dict[str, Any]]]:
    """Every row, with the recording's name."""
    for path in sorted(VECTORS.glob("*.json")):
        for row in rows(path.stem):
            yield path.stem, row


def tokens() -> list[str]:
    """Every liveliness token of a node or endpoint that was recorded, each once."""
    return sorted(
        {row["key"] for _, row in all_rows() if str(row.get("key", "")).startswith(TOKEN) and "*" not in row["key"]}
    )


def golden_qos() -> dict[str, str]:
    """The golden files of rmw_zenoh's own C++ functions, by name, out of a crate of the Rust registry. Skips the test
    where cargo cannot have it."""
    found = _crate_file()
    if found is None:
        pytest.skip(f"the crate {CRATE} {CRATE_VERSION} cannot be had here (cargo info {CRATE}@{CRATE_VERSION})")
    with tarfile.open(found) as crate:
        return {
            Path(member.name).name: _text(crate, member)
            for member in crate.getmembers()
            if member.name.endswith(".tsv") and "rmw_zenoh_qos" in member.name
        }


def _text(crate: tarfile.TarFile, member: tarfile.TarInfo) -> str:
    content = crate.extractfile(member)
    assert content is not None
    return content.read().decode()


@cache
def _crate_file() -> Path | None:
    home = Path(os.environ.get("CARGO_HOME", Path.home() / ".cargo"))
    pattern = f"registry/cache/*/{CRATE}-{CRATE_VERSION}.crate"
    if not list(home.glob(pattern)) and shutil.which("cargo"):
        command = ["cargo", "info", "--quiet", f"{CRATE}@{CRATE_VERSION}"]
        once = {**os.environ, "CARGO_NET_RETRY": "0"}  # workers of a parallel run may have no network
        subprocess.run(command, capture_output=True, timeout=120, check=False, env=once)
    return next(home.glob(pattern), None)
