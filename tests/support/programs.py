"""``macs VERB ...``, as a process that serves or to its end."""

from __future__ import annotations

import itertools
import json
import random
import socket
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from tests.support.processes import ROOT as ROOT
from tests.support.processes import Process, finished

READY = "ready: "


_PORTS = range(20_000, 32_768)
"""Below those that the kernel gives to whoever wants any: no connection gets one that a program shall have."""
_ports = itertools.cycle(_PORTS)
for _ in range(random.SystemRandom().randrange(len(_PORTS))):  # test runs beside each other begin elsewhere
    next(_ports)


def free_port() -> int:
    """A port of 127.0.0.1 that nobody listens on now, and that nobody else here is given soon."""
    for port in _ports:
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError  # the ports never end


class Program(Process):
    """A verb that serves."""

    def __init__(self, *argv: str, env: Mapping[str, str] | None = None, within: Sequence[str] = ()) -> None:
        super().__init__(sys.executable, "-m", "bridge", *argv, env=env, within=within)
        self.argv = argv
        self.ready = ""
        """What it said when it was ready, e.g. ``gateway on 127.0.0.1:7000``."""

    def __str__(self) -> str:
        return f"macs {' '.join(self.argv)}"

    @property
    def port(self) -> int:
        """The port in what it said when it was ready."""
        return int(self.ready.rpartition(":")[2])

    def _heard(self, line: str, *, is_log: bool) -> bool:
        is_ready = super()._heard(line, is_log=is_log)
        if is_ready:
            self.ready = line.removeprefix(READY)
        return is_ready


async def ended(*argv: str) -> tuple[int, str, str]:
    """Run ``macs ...`` to its end: exit code, stdout, stderr."""
    return await finished(sys.executable, "-m", "bridge", *argv)


async def macs(*argv: str) -> Any:
    """Run ``macs ...`` to its end and return its stdout as JSON. Fails unless it exits with 0."""
    code, out, errors = await ended(*argv)
    assert code == 0, errors
    return json.loads(out)
