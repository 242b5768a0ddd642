"""What is answered to ``/metrics``, ``/healthz``, ``/readyz`` and ``/diagnostics``, by whichever server."""

from __future__ import annotations

import json
import math
from typing import NamedTuple

from .exposition import Exposition, MissingPrometheus
from .watched import Watched

TEXT, JSON = "text/plain; charset=utf-8", "application/json"
OPEN_METRICS = "application/openmetrics-text"
"""Who accepts this in whatever version is answered in it: one answer for all who do."""
GOOD_S = 0.5
"""So long an answer is given again: of many agents it takes a loop longer than many frames."""


class Answered(NamedTuple):
    """A status, a body and its media type."""

    status: int
    body: bytes
    media_type: str


class Answers:
    """Answers for one program. Where figures cannot be written, that is what is said of them."""

    PATHS = ("/metrics", "/healthz", "/readyz", "/diagnostics")

    def __init__(self, watched: Watched) -> None:
        self._watched = watched
        self._exposition: Exposition | None = None
        self._missing = ""
        self._kept: dict[tuple[str, str], tuple[float, Answered]] = {}
        try:
            self._exposition = Exposition()
        except MissingPrometheus as missing:
            self._missing = str(missing)

    def must_write(self) -> None:
        """Raise MissingPrometheus where figures cannot be written."""
        if self._exposition is None:
            raise MissingPrometheus

    def fresh(self, path: str, accept: str, now: float) -> Answered:
        """The same as `answer`, as it is or was a moment ago: who asks all the time costs no more than who asks now
        and then."""
        if path not in ("/metrics", "/diagnostics"):
            return self.answer(path)
        about = path, OPEN_METRICS if OPEN_METRICS in accept else ""
        at, said = self._kept.get(about, (-math.inf, None))
        if said is None or now - at > GOOD_S:
            said = self.answer(*about)
            self._kept[about] = now, said
        return said

    def answer(self, path: str, accept: str = "") -> Answered:
        """What this path says; 404 for others."""
        if path == "/metrics" and self._exposition is None:
            return Answered(501, f"{self._missing}\n".encode(), TEXT)
        if path == "/metrics" and self._exposition is not None:
            body, media_type = self._exposition.write(self._watched.figures(), self._watched.histograms(), accept)
            return Answered(200, body, media_type)
        if path == "/healthz":  # whoever answers this lives
            return Answered(200, b"ok\n", TEXT)
        if path == "/readyz":
            problems = self._watched.problems()
            said = "".join(f"{problem}\n" for problem in problems) or "ok\n"
            return Answered(503 if problems else 200, said.encode(), TEXT)
        if path == "/diagnostics":
            said = json.dumps(self._watched.diagnostics(), indent=1, default=str)
            return Answered(200, said.encode() + b"\n", JSON)
        return Answered(404, f"there are {', '.join(self.PATHS)}\n".encode(), TEXT)
