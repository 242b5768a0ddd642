"""What was lost: counted by name, and logged the first time. From any thread."""

from __future__ import annotations

import logging
import threading
from collections import Counter


class Losses(Counter[str]):
    """Counts losses by name. What repeats is counted, not logged again.

    Names of what a loss concerns come from the network, so what is remembered of them is bounded.
    """

    LOGGED = 1000

    def __init__(self, log: logging.Logger) -> None:
        super().__init__()
        self._log = log
        self._lock = threading.Lock()
        self._logged: set[tuple[str, str]] = set()

    def note(self, name: str, about: str, text: str, count: int = 1) -> None:
        """Count a loss; log it the first time it concerns ``about``."""
        if self._is_first(name, about, count):
            self._log.warning("%s: %s (logged once, counted as %s)", about, text, name)

    def once(
        self,
        name: str,
        text: str,
        *args: object,
        about: str = "",
        count: int = 1,
        level: int = logging.WARNING,
        exc_info: bool = False,
    ) -> None:
        """Count a loss; log ``text`` with its ``args`` the first time, whatever it concerns unless that is said. With
        ``count`` 0 somebody else counts it."""
        if self._is_first(name, about, count):
            self._log.log(level, f"{text} (logged once, counted as {name})", *args, exc_info=exc_info)

    def _is_first(self, name: str, about: str, count: int) -> bool:
        with self._lock:
            if count:
                self[name] += count
            if len(self._logged) >= self.LOGGED:
                about = ""  # names that others make up hide no loss of another kind
            if (name, about) in self._logged:
                return False
            self._logged.add((name, about))
            return True
