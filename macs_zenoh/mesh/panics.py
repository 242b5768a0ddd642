"""What happens when Zenoh panics: the program ends, so that whoever watches over it starts it again.

A panic leaves Zenoh's locks poisoned: from then on some calls panic as well and others do nothing, for good, while the
process goes on. Nobody reaches it, and everybody takes it for alive.
"""

from __future__ import annotations

import asyncio
import logging
import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, cast

import zenoh

from macs_zenoh.handles import Callbacks, Handle

log = logging.getLogger("macs.mesh")

PANICKED = 70
"""The program's exit code: an internal software error, as in sysexits.h."""

LAST_WORDS_S = 0.5
"""How long what must still be said may take, as a robot's stop messages."""

_last_words: Callbacks[Callable[[], None]] = Callbacks()
"""Of the whole process: a panic ends all of it."""


def last_words(say: Callable[[], None]) -> Handle:
    """Call ``say``, from any thread, before a panic ends this program."""
    return _last_words.add(say)


def is_panic(error: object) -> bool:
    """Whether this is a panic of Zenoh. Its class, a BaseException, is in no module that could be imported."""
    return type(error).__name__ == "PanicException"


def end_if_panic(error: object) -> None:
    """End the program if Zenoh has panicked."""
    if is_panic(error):
        _end(error)


def _end(error: object) -> None:
    """End the program: past all that would be cleaned up, as with an open session that would hang."""
    log.critical("Zenoh has panicked: %s; this program ends, exit code %d", error, PANICKED)
    for last in (_say_last_words, _write_out):  # neither may keep this program from ending
        ending = threading.Thread(target=last, name="macs-last-words", daemon=True)
        ending.start()
        ending.join(LAST_WORDS_S)
    os._exit(PANICKED)


def _write_out() -> None:
    """What was logged, and printed: nothing does that after `os._exit`."""
    for written in (*logging.getLogger().handlers, sys.stdout, sys.stderr):
        with suppress(Exception):
            written.flush()


def _say_last_words() -> None:
    for say in _last_words:
        try:
            say()
        except Exception:
            log.exception("at the end")


def end_on_panics(loop: asyncio.AbstractEventLoop) -> None:
    """End the program also for a panic that comes out of a callback or a task of this loop."""
    before = loop.get_exception_handler()

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        end_if_panic(context.get("exception"))
        if before is not None:
            before(loop, context)
        else:
            loop.default_exception_handler(context)

    loop.set_exception_handler(handle)


def watched(session: zenoh.Session) -> zenoh.Session:
    """The same session; a call of it that panics ends the program."""
    return cast(zenoh.Session, _Watched(session))


def unwatched(session: zenoh.Session) -> zenoh.Session:
    """The session itself, for functions of Zenoh's that take one."""
    return cast(zenoh.Session, session._inner) if isinstance(session, _Watched) else session


class _Watched:
    """Passes everything on to an object of Zenoh's."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._inner, name)
        return partial(call, found) if callable(found) else found


def call(function: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """Call a function of Zenoh's; a panic ends the program."""
    try:
        result = function(*args, **options)
    except BaseException as error:
        end_if_panic(error)
        raise
    return _Watched(result) if isinstance(result, zenoh.Liveliness) else result
