"""Losses are counted by name, and logged once."""

from __future__ import annotations

import logging
import sys
import threading

import pytest

from macs_zenoh.losses import Losses

log = logging.getLogger("macs.test")


def test_each_is_counted_and_the_first_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    """What repeats is counted, not logged; what concerns somebody else is logged again, and says how it is counted."""
    losses = Losses(log)
    losses.note("bad_cdr", "/pose", "it is empty")
    losses.note("bad_cdr", "/pose", "it is empty", 4)
    losses.note("bad_cdr", "/scan", "it is empty")
    assert losses == {"bad_cdr": 6}
    assert caplog.messages == [
        "/pose: it is empty (logged once, counted as bad_cdr)",
        "/scan: it is empty (logged once, counted as bad_cdr)",
    ]


def test_once_is_once_whatever_it_concerns(caplog: pytest.LogCaptureFixture) -> None:
    """Several at a time are the first once only, and what somebody else counts is not counted here."""
    losses = Losses(log)
    for key in ("a", "b"):
        losses.once("bad_frame", "a frame on %s cannot be used", key, count=3)
    losses.once("late", "%s is late", "c", count=0, level=logging.ERROR)
    assert dict(losses) == {"bad_frame": 6}
    assert caplog.messages == [
        "a frame on a cannot be used (logged once, counted as bad_frame)",
        "c is late (logged once, counted as late)",
    ]
    assert [record.levelname for record in caplog.records] == ["WARNING", "ERROR"]


def test_what_is_remembered_is_bounded(caplog: pytest.LogCaptureFixture) -> None:
    """Names come from the network: of more than can be remembered one more is told, and the first of another kind."""
    losses = Losses(log)
    for number in range(2 * Losses.LOGGED):
        losses.note("no_node", str(number), "nobody registered it")
    assert losses["no_node"] == 2 * Losses.LOGGED
    losses.note("bad_cdr", "/pose", "it is empty")
    losses.note("bad_cdr", "/scan", "it is empty")
    assert len(caplog.messages) == Losses.LOGGED + 2
    assert caplog.messages[-1].startswith("/pose: it is empty")


def test_threads_lose_no_count(caplog: pytest.LogCaptureFixture) -> None:
    """Counted in several threads at once nothing is missing, and it is logged once."""
    losses, interval = Losses(log), sys.getswitchinterval()
    threads = [threading.Thread(target=lambda: [losses.once("late", "late") for _ in range(5000)]) for _ in range(4)]
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert losses["late"] == 20_000
    assert len(caplog.messages) == 1
