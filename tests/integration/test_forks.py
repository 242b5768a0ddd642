"""`tests.support.forks`: a program that was forked does what one does that was executed."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from tests.support import starter as starting
from tests.support.forks import ROOT, Forked, Starter
from tests.support.programs import free_port


@pytest.fixture(scope="module")
def starter() -> Iterator[Starter]:
    with Starter(os.environ) as starter:
        yield starter


async def executed(argv: Sequence[str], env: Mapping[str, str]) -> tuple[int | None, bytes, bytes]:
    pipe = asyncio.subprocess.PIPE
    command = (sys.executable, "-m", "bridge", *argv)
    process = await asyncio.create_subprocess_exec(*command, cwd=ROOT, env=env, stdout=pipe, stderr=pipe)
    out, errors = await process.communicate()
    return process.returncode, out, errors


@pytest.mark.parametrize(
    "argv",
    [
        ["keys", "--json"],
        ["--version"],
        ["topic"],
        ["nonsense"],
        ["gateway", "--port", "none"],
        ["ls", "--timeout", "0.2"],
    ],
    ids=" ".join,
)
async def test_it_says_and_returns_the_same(starter: Starter, argv: list[str]) -> None:
    """Data, complaints and exit codes; what the environment says counts."""
    env = {**os.environ, "MACS_CONNECT": f"tcp/127.0.0.1:{free_port()}", "COLUMNS": "60"}
    forked = await starter.fork("bridge", argv, env)
    said = await forked.communicate()
    assert (forked.returncode, *said) == await executed(argv, env)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 0), (signal.SIGKILL, -9)])
async def test_it_is_ended_by_the_same(starter: Starter, number: signal.Signals, code: int) -> None:
    """A program that serves hears of signals, and its exit code is told."""
    forked = await starter.fork("bridge", ["router", "-l", f"tcp/127.0.0.1:{free_port()}"], os.environ)
    assert forked.returncode is None
    assert (await forked.stdout.readline()).startswith(b"ready: ")
    forked.send_signal(number)
    assert await forked.wait() == code
    with pytest.raises(ProcessLookupError):
        forked.send_signal(number)


async def test_it_reads_what_it_is_told(starter: Starter) -> None:
    """Standard input is a pipe, which ends with whoever told it something."""
    forked = await starter.fork("json.tool", ["--compact"], os.environ, with_input=True)
    assert forked.stdin is not None
    forked.stdin.write(b'{"a": [1, 2]}')
    assert await forked.communicate() == (b'{"a":[1,2]}\n', b"")
    assert forked.returncode == 0


async def test_it_has_nothing_of_the_others(starter: Starter) -> None:
    """Descriptors of programs that run are not left to those that come: the end of each is seen."""
    made: list[Forked] = []
    try:
        for _ in range(3):
            made.append(await starter.fork("bridge", ["router", "-l", f"tcp/127.0.0.1:{free_port()}"], os.environ))
            await made[-1].stdout.readline()
        kept = [{path.readlink() for path in Path(f"/proc/{forked.pid}/fd").iterdir()} for forked in made]
    finally:
        for forked in made:
            forked.kill()
    for forked in made:
        await forked.communicate()
    pipes = [{str(path) for path in each if str(path).startswith("pipe:")} for each in kept]
    assert all(pipes)
    assert set.intersection(*pipes) == set()


async def test_who_leaves_a_session_open_is_known(router: str) -> None:
    """Such a program ends the long way, where it hangs as one that was executed does."""
    before = len(starting.open_sessions())
    async with await Mesh.open(MeshSettings(connect=[router])):
        assert len(starting.open_sessions()) == before + 1
    assert len(starting.open_sessions()) == before
