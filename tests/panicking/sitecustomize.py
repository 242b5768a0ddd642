"""Put before everything else on a program's path: its Zenoh really panics, two seconds after it joined a mesh, or as
soon as there is a file that ``MACS_TEST_PANIC_WHEN`` names.

``MACS_TEST_PANIC`` says where: in a ``call`` of the program, in a ``callback`` of its loop, or ``hidden``, in a place
from which nobody hears of it.
"""

import os
from contextlib import suppress
from pathlib import Path

from macs_zenoh.mesh import Mesh, panics

LONG = "a/" + "b" * 70_000
"""Zenoh writes the length of a key in 16 bits."""

_init = Mesh.__init__


def _joined(self, *args, **options):  # type: ignore[no-untyped-def]
    _init(self, *args, **options)
    session = panics.unwatched(self._session)

    def panic() -> None:
        where = os.environ["MACS_TEST_PANIC"]
        if where == "call":
            self.put_unasked(LONG, b"")
        elif where == "callback":
            session.put(LONG, b"")
        else:
            with suppress(BaseException):
                session.liveliness().declare_token(LONG)

    def look(when: Path) -> None:
        if when.exists():
            panic()
        else:
            self._loop.call_later(0.02, look, when)

    if "MACS_TEST_PANIC_WHEN" in os.environ:
        look(Path(os.environ["MACS_TEST_PANIC_WHEN"]))
    else:
        self._loop.call_later(2.0, panic)


if "MACS_TEST_PANIC" in os.environ:
    Mesh.__init__ = _joined  # type: ignore[method-assign]
