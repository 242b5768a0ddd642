"""The processes of a run: programs under measurement and workers that load them. All end with the run."""

from __future__ import annotations

import json
import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from tests.support.processes import ROOT
from tests.support.programs import free_port

UNLIMITED = Path(__file__).with_name("unlimited.toml")
GATEWAY = ("-m", "bridge", "gateway", "--settings", str(UNLIMITED))

START_S = 15.0
"""How long a program may take until it says that it is ready."""

RUN_S = 60.0
"""The longest that one measurement may take."""

STOP_S = 5.0
"""How long a program may take to end before it is killed."""

Answer = dict[str, Any]


class ProgramFailed(Exception):
    """A process of the run ended, or did not answer in time; the message ends with its last log lines."""


class Program:
    """One Python process. It says on stdout when it is ready, and ends when its stdin does.

    A worker (`benchmarks.worker`) then takes commands as JSON lines and gives one JSON line back for each.
    """

    def __init__(self, name: str, *arguments: str) -> None:
        self.name = name
        self.log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - closed in stop
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=ROOT,
            env={**os.environ, "MACS_STOP_WITH_STDIN": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            text=True,
        )
        threading.Thread(target=self._read, daemon=True).start()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def used_s(self) -> float:
        """CPU time that it has taken so far, in user and kernel."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    @property
    def memory_mb(self) -> float:
        """What it has resident."""
        pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def line(self, timeout_s: float = START_S) -> str:
        """The next line of its output. Raises ProgramFailed when there is none in time."""
        try:
            line = self._lines.get(timeout=timeout_s)
        except queue.Empty:
            raise ProgramFailed(f"{self.name} said nothing for {timeout_s:g} s\n{self.log_tail()}") from None
        if line is None:
            raise ProgramFailed(f"{self.name} has ended\n{self.log_tail()}")
        return line

    def tell(self, do: str, **arguments: object) -> None:
        """Give a worker something to do; `answer` waits for its result."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"do": do, **arguments}) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise ProgramFailed(f"{self.name} has ended\n{self.log_tail()}") from None

    def answer(self, takes_s: float = 0.0) -> Answer:
        """A worker's next result. Raises ProgramFailed when it has none within ``RUN_S`` beyond what it takes."""
        answer: Answer = json.loads(self.line(takes_s + RUN_S))
        return answer

    def ask(self, do: str, **arguments: object) -> Answer:
        """`tell` and `answer`."""
        self.tell(do, **arguments)
        return self.answer()

    def log_tail(self, lines: int = 15) -> str:
        """The end of what it wrote to stderr."""
        text = os.pread(self.log.fileno(), 1 << 20, 0).decode(errors="replace")
        return "\n".join(f"  {self.name}: {line}" for line in text.splitlines()[-lines:])

    def stop(self) -> None:
        """End it: by the end of its stdin, then by signals."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        for harder in (self._process.terminate, self._process.kill):
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                harder()
        self._process.wait(STOP_S)

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)
        self._lines.put(None)


class Stage:
    """Starts programs and ends all of them, the last one first. A context manager.

    ``profile_into``: gateways run under cProfile, which writes there (``gateway-0.prof`` …).
    """

    def __init__(self, profile_into: Path | None = None) -> None:
        self.programs: list[Program] = []
        self._said: list[str] = []
        self._profile_into = profile_into
        self._gateways = 0

    def __enter__(self) -> Stage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.clear()

    def clear(self) -> None:
        """End all that runs."""
        while self.programs:
            program = self.programs.pop()
            program.stop()
            self._said += _warnings(program)
            program.log.close()

    def warnings(self) -> list[str]:
        """What the programs of ours had to say about losses and disconnects."""
        return [*self._said, *(line for program in self.programs for line in _warnings(program))]

    def router(self) -> int:
        """Start ``macs router``; returns its port on 127.0.0.1."""
        port = free_port()
        self._start("router", "-m", "bridge", "router", "-l", f"tcp/127.0.0.1:{port}").line()
        return port

    def gateway(self, router_port: int, *options: str) -> int:
        """Start ``macs gateway``; returns its port on 127.0.0.1."""
        under: list[str] = []
        if self._profile_into is not None:
            under = ["-m", "cProfile", "-o", str(self._profile_into / f"gateway-{self._gateways}.prof")]
        self._gateways += 1
        connect = f"tcp/127.0.0.1:{router_port}"
        gateway = self._start("gateway", *under, *GATEWAY, "--port", "0", "-e", connect, *options)
        return _port_in(gateway.line())

    def relay(self, *certificate_and_key: str) -> int:
        """Start the plain asyncio relay, or with files for it one over TLS; returns its port on 127.0.0.1."""
        return _port_in(self._start("relay", "-m", "benchmarks.relay", *certificate_and_key).line())

    def worker(self, module: str, *arguments: object) -> tuple[Program, Answer]:
        """Start a worker; returns it and what it said when it was ready."""
        program = self._start(module, "-m", f"benchmarks.{module}", *map(str, arguments))
        return program, program.answer()

    def _start(self, name: str, *arguments: str) -> Program:
        program = Program(name, *arguments)
        self.programs.append(program)
        return program


def _warnings(program: Program) -> list[str]:
    return [line for line in program.log_tail(1000).splitlines() if re.search(r"\b[WE] macs\.|lost in all", line)]


def _port_in(ready: str) -> int:
    found = re.search(r":(\d+)\s*$", ready)
    if found is None:
        raise ProgramFailed(f"no port in {ready!r}")
    return int(found[1])
