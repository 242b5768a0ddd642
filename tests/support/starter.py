"""The process of which programs are forked: it has loaded what they need, and has done nothing else.

``python -m tests.support.starter DESCRIPTOR MODULE...`` loads the modules, says over the socket how many threads it
has, and starts what it is then asked for, one request a packet: ``{"module", "argv", "cwd", "env"}`` with three
descriptors, for standard output, standard error, and what becomes of the program: its pid on a line, and at its end
its exit code as `subprocess` has it; with one for standard input before them where it reads any. It ends when nobody
can ask any more.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from macs_zenoh.versions import installed

REQUEST_BYTES = 1 << 20


def main() -> None:
    """Returns when it has ended, and in each program when that has."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    for module in sys.argv[2:]:
        with suppress(ImportError):  # whoever needs it says so
            importlib.import_module(module)
    for package in ("eclipse-zenoh", "macs-zenoh"):
        installed(package)  # which looks through all that is installed
    gc.collect()
    gc.freeze()  # what is there is written to by no collection, and so is shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for those who run
    channel.send(b"%d" % len(list(Path("/proc/self/task").iterdir())))
    asked = _serve(channel)
    if asked is not None:
        _become(*asked)


def _serve(channel: socket.socket) -> tuple[dict[str, Any], list[int]] | None:
    """Fork. Returns in the program, with what it is to be; None when this process is not needed any more."""
    children: dict[int, int] = {}
    woken, wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    while True:
        ready, _, _ = select.select([channel, woken], [], [])
        if woken in ready:
            os.read(woken, 4096)
            _tell_ends(children)
        if channel not in ready:
            continue
        request, descriptors, *_ = socket.recv_fds(channel, REQUEST_BYTES, 4)
        if not request:
            return None
        pid = os.fork()
        if not pid:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            for descriptor in (woken, wake, *children.values()):
                os.close(descriptor)
            channel.close()
            return json.loads(request), descriptors
        *theirs, children[pid] = descriptors
        for descriptor in theirs:
            os.close(descriptor)
        _tell(children[pid], pid)


def _tell_ends(children: dict[int, int]) -> None:
    for pid in list(children):
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            descriptor = children.pop(pid)
            _tell(descriptor, os.waitstatus_to_exitcode(status))
            os.close(descriptor)


def _tell(descriptor: int, number: int) -> None:
    with suppress(BrokenPipeError):  # nobody wants to know
        os.write(descriptor, b"%d\n" % number)


def _become(asked: dict[str, Any], descriptors: list[int]) -> None:
    """Be that program, from its first line on."""
    *given, out, errors, _ = descriptors
    for stdin in given:
        os.dup2(stdin, 0)
    os.dup2(out, 1)
    os.dup2(errors, 2)
    for descriptor in descriptors:
        os.close(descriptor)
    os.chdir(asked["cwd"])
    os.environ.clear()
    os.environ.update(asked["env"])
    sys.argv = ["", *asked["argv"]]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        runpy.run_module(asked["module"], run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            _end(end.code or 0)
        raise


def _end(code: int) -> None:
    """End as Python does, but without taking apart what was loaded, which writes to all that is shared: two thirds of
    what a short program costs. Returns where that may matter: a session that was left open hangs there."""
    if open_sessions():
        return
    threading._shutdown()  # type: ignore[attr-defined] # waits for those that are no daemons
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):  # Python says so, and has an exit code for it
        return
    os._exit(code & 0xFF)


def open_sessions() -> list[object]:
    """Zenoh's sessions that nobody has closed, of those that were opened since what was there was frozen."""
    sessions = (kept._inner for kept in gc.get_objects() if type(kept).__name__ == "_Watched")
    return [each for each in sessions if hasattr(each, "is_closed") and not each.is_closed()]


if __name__ == "__main__":
    main()
