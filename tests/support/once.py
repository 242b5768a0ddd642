"""What takes seconds to make is made once in a run, or once for all runs, by whichever worker needs it first."""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import sys
import sysconfig
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

KEPT = Path(__file__).parents[2] / "build" / "made-for-tests"
"""`make clean` removes it."""


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that ``make`` filled; workers of one run share it."""
    base = factory.getbasetemp()
    return _made((base.parent if base.name.startswith("popen-") else base) / f"once-{name}", make)


def made_of(name: str, sources: Iterable[Path], make: Callable[[Path], object]) -> Path:
    """The same for all runs, as long as the sources, files or folders, are as they were, and what is installed too."""
    state = hashlib.sha256(
        repr((sys.version, sorted(path.name for path in Path(sysconfig.get_paths()["purelib"]).iterdir()))).encode()
    )
    for source in sources:
        for path in sorted(source.rglob("*")) if source.is_dir() else [source]:
            if path.is_file() and path.suffix != ".pyc":
                state.update(f"\0{path.relative_to(source.parent)}\0".encode() + path.read_bytes())
    KEPT.mkdir(parents=True, exist_ok=True)
    return _made(KEPT / f"{name}-{state.hexdigest()[:16]}", make)


def _made(folder: Path, make: Callable[[Path], object]) -> Path:
    done = folder.with_name(f"{folder.name}.done")
    with folder.with_name(f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)  # somebody was interrupted
            folder.mkdir()
            make(folder)
            done.touch()
    return folder
