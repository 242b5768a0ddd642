"""Running a verb that goes on until somebody stops it."""

from __future__ import annotations

import asyncio
import faulthandler
import logging
import os
import signal
import sys
from collections.abc import Callable, Coroutine
from typing import Any

from bridge import memory
from bridge.cli import output

log = logging.getLogger("macs")

READY = "ready: "
"""How a program that serves begins its first line on stdout."""

STOP_WITH_STDIN = "MACS_STOP_WITH_STDIN"
"""Set by ``macs up`` for its children: end of stdin means that it is gone, however it went."""


LAST_WORDS_S = 1.0
"""How long tasks may take to end that were left behind: a program that is stopped is gone within 2 s."""

STOPS = ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGVTALRM", "SIGPROF", "SIGXCPU", "SIGPWR")
"""Signals that end a program unless it takes them, and that it can take. One that ends by them must end as by Ctrl-C,
else the last command to a robot stays. One that was ignored when the program started stays so: that is ``nohup``."""

OVERDUE_S = 2.0
"""A program that is to end within a time ends at once by another signal so long after the first."""

INTERRUPTED = 130
"""The exit code, as with any program that Ctrl-C ends, of one that was to find or do something: nobody must take it
for a confirmation."""


SWITCH_S = 0.001
"""So soon Python's threads take turns in a robot's program, and in a gateway."""


def switch_soon() -> None:
    """For who has to stop a robot: that comes in a thread of Zenoh's, which waits for its turn several times while the
    loop has much to do, 5 ms each unless this is called. And for a gateway, whose loop waits for Zenoh's threads after
    each piece that TLS encrypts."""
    sys.setswitchinterval(SWITCH_S)


def until_stopped(
    work: Callable[[], Coroutine[Any, Any, int]], *, interrupted: int = 0, within_s: float | None = None
) -> int:
    """Run ``work`` to its end and return its exit code; SIGINT and those of `STOPS` cancel it. For who serves until it
    is stopped that is a success; for others ``interrupted`` is the exit code then.

    A second Ctrl-C ends the process at once, for whoever does not want to wait for a clean close. ``within_s``: so
    long after it was told to stop the process ends in any case and says where it hung, also where a library keeps all
    of Python waiting; and another signal ends it at once when it is overdue.
    """
    loop = _new_loop()
    try:
        asyncio.set_event_loop(loop)
        return loop.run_until_complete(_stoppable(work, interrupted, within_s))
    finally:
        loop.run_until_complete(_end_what_is_left())
        loop.run_until_complete(loop.shutdown_asyncgens())
        asyncio.set_event_loop(None)
        loop.close()
        if within_s is not None:
            faulthandler.cancel_dump_traceback_later()


async def _end_what_is_left() -> None:
    """Cancel the tasks that ``work`` left behind and let them end: asyncio complains of each one it destroys."""
    left = asyncio.all_tasks() - {asyncio.current_task()}
    if not left:
        return
    for task in left:
        task.cancel()
    ended, _ = await asyncio.wait(left, timeout=LAST_WORDS_S)
    for task in ended:
        if not task.cancelled() and (error := task.exception()) is not None:
            log.debug("%s ended with %r", task.get_name(), error)  # nobody waits for it any more


async def _stoppable(work: Callable[[], Coroutine[Any, Any, int]], interrupted: int, within_s: float | None) -> int:
    loop = asyncio.get_running_loop()
    task = loop.create_task(work())
    stopped = False

    def stop() -> None:
        nonlocal stopped
        task.cancel()
        if within_s is not None and not stopped:
            faulthandler.dump_traceback_later(within_s, exit=True)  # by a thread that needs no turn of Python's
            loop.call_later(OVERDUE_S, _end_by_signals, loop)
        stopped = True

    def interrupt() -> None:
        loop.add_signal_handler(signal.SIGINT, os._exit, INTERRUPTED)
        stop()

    loop.add_signal_handler(signal.SIGINT, interrupt)
    # Not twice as for Ctrl-C: under systemd a child of `macs up` gets one SIGTERM from each of the two.
    for name in STOPS:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            loop.add_signal_handler(number, stop)
    if os.environ.pop(STOP_WITH_STDIN, None):
        loop.add_reader(sys.stdin.fileno(), _stop_at_end_of_stdin, loop, stop)
    try:
        return await task
    except asyncio.CancelledError:
        return interrupted


def _end_by_signals(loop: asyncio.AbstractEventLoop) -> None:
    """From now on the kernel ends this process by each of them, whatever Python does."""
    for name in STOPS:
        number = getattr(signal, name, None)
        if number is not None and loop.remove_signal_handler(number):
            signal.signal(number, signal.SIG_DFL)


def _stop_at_end_of_stdin(loop: asyncio.AbstractEventLoop, stop: Callable[[], None]) -> None:
    if not os.read(sys.stdin.fileno(), 4096):
        loop.remove_reader(sys.stdin.fileno())
        stop()


def _new_loop() -> asyncio.AbstractEventLoop:
    """uvloop where it exists: it doubles what a gateway can pass on."""
    try:
        import uvloop
    except ImportError:
        return asyncio.new_event_loop()
    loop: asyncio.AbstractEventLoop = uvloop.new_event_loop()
    return loop


def say_ready(what: str) -> None:
    """Print on stdout that this program does its work now, and where: people and ``macs up`` wait for this line."""
    memory.settle()
    output.say_if_possible(f"{READY}{what}")
