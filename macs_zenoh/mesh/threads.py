"""Zenoh's threads in a Python program: which there are, and what it costs them to call Python."""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

RUNTIME = "ZENOH_RUNTIME"
"""Zenoh reads this variable when the first session of a process is opened."""

SHARED = "(acc:(handover:rx),app:(handover:rx),net:(handover:rx))"
"""Zenoh watches a socket in one thread, that of the task which opened it, and reads it in another: each message wakes
both. Here the two threads that read also watch, for clients: they have one link to read, so that one of the two is
always free to watch. A router's readers can all have to wait for room on one slow link, and would not see that there
is some again. Sending keeps its own thread for the same reason."""

KEPT_ATTACHED = 64
"""Threads that stay attached to Python; Zenoh has a handful."""

_here = threading.local()
_attached = 0
_attached_lock = threading.Lock()


@contextmanager
def shared_threads(mode: str) -> Iterator[None]:
    """Around the opening of a session: a client's threads do both, unless the environment says otherwise, or a session
    was opened before. Child processes hear nothing of it, they may be routers."""
    ours = mode == "client" and RUNTIME not in os.environ
    if ours:
        os.environ[RUNTIME] = SHARED
    try:
        yield
    finally:
        if ours:
            os.environ.pop(RUNTIME, None)


def keep_attached() -> None:
    """Let this thread, one of Zenoh's, keep its Python thread state when its callback returns.

    Python makes a state for each call from a foreign thread, and gives it back after the call with the memory of its
    stack, which interrupts the other cores: 10 µs for a callback that takes 2.
    """
    global _attached
    if getattr(_here, "kept", False):
        return
    _here.kept = True
    with _attached_lock:
        if _attached >= KEPT_ATTACHED:
            return
        _attached += 1
    ctypes.pythonapi.PyGILState_Ensure()  # never released: PEP 311 counts these calls
