"""Programs of ours without what it costs to load them: much of the processor's time of a test run was that.

In a parallel run a program that is ``python -m bridge ...`` is forked of a process that has loaded its modules
(`tests.support.starter`), and from there on it is the same, but that it does not take them apart at its end. Whoever
runs tests one by one, as those that measure time, has programs that are executed, and so have tests of how programs
start.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

ROOT = Path(__file__).parents[2]
LINE_BYTES = 64 << 20
"""zenohd logs its whole configuration, with every access rule, as one line."""

MODULES = (
    *("bridge.cli.agent", "bridge.cli.gateway", "bridge.cli.router", "bridge.cli.topic", "bridge.gateway"),
    *("bridge.cli.doctor", "bridge.cli.ls", "bridge.cli.record", "bridge.cli.stop"),
    *("bridge.doctor.first", "bridge.graph.echo", "bridge.graph.site", "bridge.headset.script"),
    *("bridge.recording.program", "bridge.rmw_zenoh.program", "bridge.router"),
    *("numpy", "uvloop", "yaml", "aiohttp.web", "lz4.frame", "rich.table", "rosbags.typesys", "cryptography.x509"),
    *("ament_index_python", "rcl_interfaces.msg", "email.parser", "encodings.idna", "importlib.metadata"),
)
"""What is loaded, as far as it is here: most programs need most of it. Nothing of rclpy, which has threads at once."""
OURS = ("bridge", "bridge.cli.demo_robot")

READ_WHEN_USED = re.compile(r"(MACS|PYTEST|ROS|RUST)_\w+|COLUMNS|LINES|NO_COLOR|FORCE_COLOR")
"""Variables that mean nothing to Python itself, nor to a module that is being loaded."""
STARTERS = 6
"""For so many settings of the others there may be one."""


class Forked:
    """A program, as `asyncio.subprocess.Process` is one."""

    def __init__(
        self,
        pid: int,
        stdin: asyncio.StreamWriter | None,
        out: asyncio.StreamReader,
        errors: asyncio.StreamReader,
        told: asyncio.StreamReader,
    ) -> None:
        self.pid = pid
        self.stdin = stdin
        self.stdout, self.stderr = out, errors
        self.returncode: int | None = None
        self._ended = asyncio.get_running_loop().create_task(self._end(told))

    async def _end(self, told: asyncio.StreamReader) -> int:
        line = await told.readline()
        assert line, "the process that it was forked of has ended"
        self.returncode = int(line)
        return self.returncode

    async def wait(self) -> int:
        """Its exit code."""
        return await asyncio.shield(self._ended)

    async def communicate(self) -> tuple[bytes, bytes]:
        """End its input; all that it writes until its end."""
        if self.stdin is not None:
            self.stdin.close()
        out, errors = await asyncio.gather(self.stdout.read(), self.stderr.read())
        await self.wait()
        return out, errors

    def send_signal(self, number: int) -> None:
        """Raises ProcessLookupError when it has ended."""
        if self.returncode is not None:
            raise ProcessLookupError
        with suppress(ProcessLookupError):  # it has this moment
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)


class Starter:
    """A process of which others are forked."""

    def __init__(self, env: Mapping[str, str]) -> None:
        """Wait until it has loaded them."""
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, "-m", "tests.support.starter", str(theirs.fileno()), *MODULES]
            self._process = subprocess.Popen(
                command,
                cwd=ROOT,
                env={**env, "OPENBLAS_NUM_THREADS": "1"},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
            )
        threads = self._channel.recv(100)
        assert threads == b"1", f"a process with {threads!r} threads cannot be forked"

    def __enter__(self) -> Starter:
        return self

    def __exit__(self, *_: object) -> None:
        """Programs that were forked of it go on."""
        self._channel.close()
        self._process.wait()

    async def fork(
        self, module: str, argv: Sequence[str], env: Mapping[str, str], *, with_input: bool = False
    ) -> Forked:
        """Have a program; without input it reads nothing."""
        loop = asyncio.get_running_loop()
        readers, theirs, stdin = [], [], None
        try:
            if with_input:
                read, write = os.pipe()
                theirs.append(read)
                stdin = await _writer(write)
            for _ in range(3):
                read, write = os.pipe()
                theirs.append(write)
                readers.append(asyncio.StreamReader(limit=LINE_BYTES))
                protocol = partial(asyncio.StreamReaderProtocol, readers[-1])
                await loop.connect_read_pipe(protocol, os.fdopen(read, "rb", 0))
            asked = {"module": module, "argv": list(argv), "cwd": str(ROOT), "env": dict(env)}
            socket.send_fds(self._channel, [json.dumps(asked).encode()], theirs)
        finally:
            for descriptor in theirs:
                os.close(descriptor)
        out, errors, told = readers
        return Forked(int(await told.readline()), stdin, out, errors, told)


async def _writer(descriptor: int) -> asyncio.StreamWriter:
    """The end of a pipe that is written to."""
    loop = asyncio.get_running_loop()
    pipe = os.fdopen(descriptor, "wb", 0)
    transport, protocol = await loop.connect_write_pipe(
        lambda: asyncio.StreamReaderProtocol(asyncio.StreamReader()), pipe
    )
    return asyncio.StreamWriter(transport, protocol, None, loop)


_starters: dict[frozenset[tuple[str, str]], Starter] = {}
_lock = threading.Lock()


async def started(
    command: Sequence[str], env: Mapping[str, str], stdin: int | None = None
) -> asyncio.subprocess.Process | Forked:
    """Start a command, forked where that is the same as executed. Its output is piped."""
    if stdin in (None, asyncio.subprocess.PIPE) and _is_ours(command):
        starter = await asyncio.to_thread(_starter, env)
        if starter is not None:
            return await starter.fork(command[2], command[3:], env, with_input=stdin is not None)
    pipe = asyncio.subprocess.PIPE
    return await asyncio.create_subprocess_exec(
        *command, cwd=ROOT, env=env, stdin=stdin, stdout=pipe, stderr=pipe, limit=LINE_BYTES
    )


def _is_ours(command: Sequence[str]) -> bool:
    parallel = "PYTEST_XDIST_WORKER" in os.environ and sys.platform == "linux"
    return parallel and tuple(command[:2]) == (sys.executable, "-m") and command[2] in OURS


def _starter(env: Mapping[str, str]) -> Starter | None:
    """The one for it; None where it has to be executed."""
    key = frozenset((name, value) for name, value in env.items() if not READ_WHEN_USED.fullmatch(name))
    with _lock:
        if key not in _starters and len(_starters) < STARTERS:
            _starters[key] = Starter(env)
        return _starters.get(key)
