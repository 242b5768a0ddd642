"""Threads that put what is large: where there can be none, and how several end."""

from __future__ import annotations

import logging
import threading
from typing import Any

import pytest

from macs_zenoh.losses import Losses
from macs_zenoh.mesh.sender import Sender, close_together

log = logging.getLogger("test")
OUTLET: Any = None


def test_without_a_thread_who_puts_does_it_himself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is lost or left waiting, it is told once, and as soon as there can be threads one does it."""

    def no_more(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    put: list[tuple[bytes, str]] = []
    done = threading.Event()

    def note(_: Any, payload: Any) -> None:
        put.append((bytes(payload), threading.current_thread().name))
        if payload == b"three":
            done.set()

    told, drops = list[int](), Losses(log)
    sender = Sender(1 << 20, note, lambda: None, drops)
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", no_more)
        assert sender.put(OUTLET, b"one")
        assert sender.put(OUTLET, b"two", "key")
        assert sender.idle
        assert not sender.has("key")
        sender.when_sent(lambda: told.append(1))
    assert told == [1]
    me = threading.current_thread().name
    assert put == [(b"one", me), (b"two", me)]
    assert drops["no_thread"] == 2
    assert sender.put(OUTLET, b"three")
    assert done.wait(10)
    assert put[2] == (b"three", "macs-sender")
    sender.close(10)


def test_several_end_together() -> None:
    """What one has to put may take as long as others need to end: nobody is waited for before all are told."""
    other_ended = threading.Event()
    waited = list[bool]()
    first = Sender(1 << 20, lambda *_: waited.append(other_ended.wait(10)), lambda: None, Losses(log))
    other = Sender(1 << 20, lambda *_: None, lambda: None, Losses(log))
    assert first.put(OUTLET, b"waits")
    assert other.put(OUTLET, b"goes")
    thread = other._thread
    assert thread is not None

    def watch() -> None:
        thread.join()
        other_ended.set()

    watching = threading.Thread(target=watch)
    watching.start()
    close_together((first, other), 10)
    assert waited == [True]
    watching.join()
