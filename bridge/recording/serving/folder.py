"""The folder of recordings: which files there are, and what is known of each. Nothing outside of it is ever opened."""

from __future__ import annotations

import re
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

from bridge.recording.bag import Bag, Unfinished
from bridge.recording.happened import happened
from bridge.recording.room import known, taken
from macs_zenoh.errors import MacsError, UsageError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}\.mcap", re.ASCII)
SHOWN = 500
"""So many files are listed, the newest first."""
TOLD = 2000
"""So much of what happened in a file is told."""


class Folder:
    """One folder. Its methods read files: they are for a thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[tuple[str, int, int], dict[str, Any]] = {}

    def file(self, name: str) -> Path:
        """The file of a name that somebody said. Raises UsageError: it is no name, or no file of this folder."""
        path = self.path / name
        if NAME.fullmatch(name) is None or known(path) is None:
            raise UsageError(f"there is no recording called {name[:80]!r}")
        return path

    def new(self, stem: str = "macs") -> Path:
        """A path that no file has."""
        stamp = time.strftime("%Y-%m-%d_%H-%M-%S")
        path, number = self.path / f"{stem}_{stamp}.mcap", 0
        while path.exists():
            number += 1
            path = self.path / f"{stem}_{stamp}_{number}.mcap"
        return path

    @property
    def bytes(self) -> int:
        """Of all recordings together."""
        return taken(self.path)

    def listed(self, being_written: Collection[str]) -> list[dict[str, Any]]:
        """What there is, the newest first; of a file that is being written its size alone."""
        files = sorted(self._files(), key=lambda each: (each[2], each[0]), reverse=True)[:SHOWN]
        told, facts_of = [], {}
        for name, size, changed_ns in files:
            about: dict[str, Any] = {"name": name, "bytes": size, "changed_ns": changed_ns}
            if name in being_written:
                told.append({**about, "state": "recording"})
                continue
            key = (name, size, changed_ns)
            facts_of[key] = facts = self._known.get(key) or self._facts(self.path / name)
            told.append({**about, **facts})
        self._known = facts_of
        return told

    def happened(self, name: str) -> dict[str, Any]:
        """What happened in a recording. Raises UsageError, BadBag."""
        found: list[dict[str, Any]] = []
        left_out = 0
        with Bag(self.file(name)) as bag:
            for each in happened(bag):
                if len(found) < TOLD:
                    found.append(each._asdict())
                else:
                    left_out += 1
            return {"start_ns": bag.start_ns, "end_ns": bag.end_ns, "happened": found, "left_out": left_out}

    def robots(self, name: str) -> list[int]:
        """The robots whose topics a recording has. Raises UsageError, BadBag."""
        with Bag(self.file(name)) as bag:
            return _robots(bag)

    def _files(self) -> list[tuple[str, int, int]]:
        found = []
        for path in self.path.iterdir():
            if NAME.fullmatch(path.name) is not None and (about := known(path)) is not None:
                found.append((path.name, *about))
        return found

    @staticmethod
    def _facts(path: Path) -> dict[str, Any]:
        try:
            with Bag(path) as bag:
                metadata = dict(bag.metadata())
                lost = {
                    name: int(n) for name, n in metadata.get("macs.lost", {}).items() if n.isdigit() and len(n) < 20
                }
                return {
                    "state": "whole",
                    "start_ns": bag.start_ns,
                    "end_ns": bag.end_ns,
                    "messages": bag.messages_in_all,
                    "channels": len(bag.channels),
                    "robots": _robots(bag),
                    "lost": lost,
                    "reason": metadata.get("macs.recording", {}).get("reason", ""),
                }
        except Unfinished:
            return {"state": "unfinished", "problem": "it has no end: macs bag repair"}
        except MacsError as error:
            return {"state": "bad", "problem": str(error)}


def _robots(bag: Bag) -> list[int]:
    said = {
        c.metadata.get("robot", "") for c in bag.channels.values() if "topic" in c.metadata and "as" not in c.metadata
    }
    return sorted(int(robot) for robot in said if robot.isascii() and robot.isdigit() and len(robot) < 6)
