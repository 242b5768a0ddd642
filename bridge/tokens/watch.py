"""Follows the file of tokens: what is changed in it holds within a moment, without a restart."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path

from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol.tokens import Tokens

from . import store

log = logging.getLogger("macs.tokens")

LOOK_S = 0.25
"""How often it is looked whether the file is another one: one call of the system, which no network file system and no
container hides from, as they do notifications."""

Seen = tuple[int, int, int, int] | None


class Watch:
    """The tokens of a file as they are now. ``on_look`` hears of each look: tokens also end with time."""

    def __init__(self, path: Path, on_look: Callable[[], None]) -> None:
        """Raises ConfigError: what is there cannot be used."""
        self.path = path
        self._on_look = on_look
        self._seen = _seen(path)
        self.tokens = store.read(path)
        self.on_read: Callable[[Tokens, Tokens], None] = lambda before, now: None
        """Hears of a file that was read again."""
        self._complained = False
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Begin to look."""
        self._timer = asyncio.get_running_loop().call_later(LOOK_S, self._look)

    def close(self) -> None:
        """Look no more."""
        if self._timer is not None:
            self._timer.cancel()

    def read_again(self) -> None:
        """Take what the file has, at once. A file that cannot be used changes nothing, and it is said."""
        seen = _seen(self.path)
        if seen == self._seen:
            return
        before = self.tokens
        try:
            self.tokens = store.read(self.path)
            self._complained = False
        except ConfigError as error:
            if not self._complained:
                self._complained = True
                log.error("tokens stay as they were: %s", error)
            return
        self._seen = seen
        self.on_read(before, self.tokens)
        log.info("%s: %d tokens", self.path, len(self.tokens.tokens))

    def _look(self) -> None:
        self.start()
        try:
            self.read_again()
        finally:  # tokens end with time, whatever becomes of their file
            self._on_look()


def _seen(path: Path) -> Seen:
    """What changes whenever the file does."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size
