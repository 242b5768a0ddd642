"""The recorded bytes of the existing programs, and a reading of their JSON that shares nothing with ours."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

VECTORS = Path(__file__).parents[1] / "vectors"


class Row(NamedTuple):
    """One frame (agent to router) or one message (router to agent). ``connection`` is "" in headset recordings."""

    number: int
    sent: bool
    data: bytes
    connection: str
    note: str


class Recording(NamedTuple):
    """One file. In a ``fault_*`` file the input counts, what the existing router made of it does not."""

    name: str
    rows: list[Row]

    @property
    def is_fault(self) -> bool:
        """Whether the file shows bad input."""
        return "fault_" in self.name

    @property
    def frames(self) -> list[bytes]:
        """What agents sent, each one whole frame."""
        return [row.data for row in self.rows if row.sent]

    @property
    def messages(self) -> list[bytes]:
        """What agents received, each one whole message; nothing where the router was at fault."""
        return [] if self.is_fault else [row.data for row in self.rows if not row.sent]


def _read(path: Path) -> Recording:
    rows = json.loads(path.read_text(encoding="utf-8"))
    return Recording(
        f"{path.parent.name}/{path.stem}",
        [
            Row(
                number,
                row["dir"] == "agent->router",
                bytes.fromhex(row["hex"]),
                row.get("conn", ""),
                str(row.get("note", "")),
            )
            for number, row in enumerate(rows)
            if row["hex"]  # empty: the stream ended here
        ],
    )


RECORDINGS = [_read(path) for path in sorted(VECTORS.glob("*/*.json"))]
BY_NAME = {recording.name: recording for recording in RECORDINGS}


def snake(key: str) -> str:
    """``agentId``, ``AgentId`` and ``agent_id`` are the same key."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", key).lower()


def reading(data: bytes) -> dict[str, Any]:
    """A JSON object with its top-level keys in snake_case, as Python's own parser reads it."""
    return {snake(key): value for key, value in json.loads(data.decode("utf-8")).items()}


def cut_around(data: bytes, boundaries: list[int]) -> Iterator[list[bytes]]:
    """``data`` in two pieces, cut at and beside every boundary."""
    for at in sorted({boundary + side for boundary in boundaries for side in (-1, 0, 1)}):
        if 0 < at < len(data):
            yield [data[:at], data[at:]]


def one_by_one(data: bytes) -> list[bytes]:
    """``data`` as single bytes."""
    return [data[at : at + 1] for at in range(len(data))]
