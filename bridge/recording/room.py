"""How much the recordings of a folder take together. Reads a folder: for a thread, or seldom."""

from __future__ import annotations

import stat
from pathlib import Path

LEAST = 1 << 20
"""With less room than this no file is begun."""
FULL = "the folder has as much as [record] folder_bytes lets it have"


def known(path: Path) -> tuple[int, int] | None:
    """Size and time of change; None for what is no plain file, as a link that leads elsewhere."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return (found.st_size, found.st_mtime_ns) if stat.S_ISREG(found.st_mode) else None


def taken(folder: Path, but: Path | None = None) -> int:
    """Bytes of all recordings in a folder, without one of them. 0 where the folder cannot be read."""
    try:
        return sum(about[0] for path in folder.glob("*.mcap") if path != but and (about := known(path)) is not None)
    except OSError:
        return 0
