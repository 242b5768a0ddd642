"""Standard streams that are closed, full, not read or not UTF-8: no tracebacks, true exit codes, services go on."""

from __future__ import annotations

import asyncio
import json
import os
import shlex
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

import macs_zenoh
from bridge.headset.client import Headset
from macs_zenoh import awareness
from tests.support.local import patient
from tests.support.processes import finished
from tests.support.programs import Program, free_port


async def shell(command: str, **env: str) -> tuple[int | None, str, str]:
    """A line of bash with pipefail; ``macs`` in it is ours."""
    macs = f"{shlex.quote(sys.executable)} -m bridge"
    code, out, errors = await finished("bash", "-o", "pipefail", "-c", command.replace("macs ", f"{macs} "), env=env)
    assert "Traceback" not in errors, errors
    assert "Exception ignored" not in errors, errors
    return code, out, errors


@pytest.mark.parametrize("verb", ["keys", "keys --json", "--help", "ls --help", "headset 127.0.0.1 pub --help"])
async def test_what_cannot_be_written_is_told(verb: str) -> None:
    """A full disk and a closed descriptor are one line and exit code 1; a reader that left is 1 without a word."""
    code, _, errors = await shell(f"macs {verb} > /dev/full")
    assert (code, len(errors.splitlines())) == (1, 1), errors
    assert "cannot write its output: No space left on device" in errors
    code, _, errors = await shell(f"macs {verb} >&-")
    assert (code, len(errors.splitlines())) == (1, 1), errors
    assert "cannot write its output: Bad file descriptor" in errors
    code, _, errors = await shell(f"macs {verb} | true")
    assert (code, errors) in ((1, ""), (0, ""))  # the second: all of it was written before
    assert await shell(f"macs {verb} > /dev/null 2>&-") == (0, "", "")


async def test_errors_that_nobody_hears_change_no_exit_code() -> None:
    """With stderr closed or full, or all of it closed, a verb ends as it would."""
    for streams in ("2>&-", "2>/dev/full", ">&- 2>&- <&-", "> /dev/full 2>/dev/full"):
        code, _, _ = await shell(f"macs keys no/such/key {streams}")
        assert code == 1, streams
        code, _, _ = await shell(f"macs gateway --workers 0 {streams}")
        assert code == 2, streams


@pytest.fixture
async def endpoint() -> AsyncIterator[str]:
    async with Program("router", "-l", f"tcp/127.0.0.1:{free_port()}") as router:
        yield router.ready.removeprefix("router on ")


@pytest.mark.parametrize("streams", [">&-", "> /dev/full", "> /dev/full 2> /dev/full", ">&- 2>&- <&-", "> >(true)"])
async def test_services_go_on_without_their_output(endpoint: str, streams: str, tmp_path: Path) -> None:
    """A gateway whose output nobody takes serves headsets, and ends with 0 when it is stopped."""
    port, pid = free_port(), tmp_path / "pid"
    gateway = f"macs gateway --port {port} -e {endpoint} {streams} & echo $! > {pid} ; wait $!"
    ended = asyncio.create_task(shell(gateway))
    headset = None
    while headset is None:
        assert not ended.done(), ended.result()
        try:
            headset = await Headset.connect("127.0.0.1", port)
        except macs_zenoh.Unreachable:
            await asyncio.sleep(0.05)
    async with headset:
        assert (await headset.online()).unity_agent_ids == [headset.id]
        os.kill(int(pid.read_text()), signal.SIGTERM)
        code, _, _ = await ended
    assert code == 0


@pytest.mark.parametrize("streams", ["", ">&-", "> /dev/full", "| true", ">&- 2>&-"])
async def test_stop_stops_all_robots_whatever_becomes_of_its_output(endpoint: str, streams: str) -> None:
    """Each robot is asked, and the exit code tells of robots; that the output is lost ends nothing."""
    stopped: set[int] = set()

    async def serve(stack: AsyncExitStack, number: int) -> None:
        async def stop(_call: macs_zenoh.Call) -> bytes:
            await asyncio.sleep(0.2 * number)
            stopped.add(number)
            return await status(_call)

        async def status(_call: macs_zenoh.Call) -> bytes:
            now = {"by": "operator/0", "seconds": 0, "times": 1}
            return json.dumps({"ros_node": "r", "stopped": True, "stop": now, "nodes": []}).encode()

        robot = await stack.enter_async_context(macs_zenoh.join("ros", id=number, settings=patient(endpoint)))
        robot.serve("stop", stop)
        robot.serve("status", status)

    async with AsyncExitStack() as stack:
        for number in (1, 2, 3):
            await serve(stack, number)
        code, out, errors = await shell(f"macs stop 1 2 3 -e {endpoint} {streams}")
    assert (code, stopped) == (0, {1, 2, 3}), out + errors


async def test_json_is_json_in_every_encoding(endpoint: str) -> None:
    """With PYTHONIOENCODING=ascii a name that is not ASCII is escaped as JSON has it, and text is not a traceback."""
    async with (
        macs_zenoh.join("ros", id=7, settings=patient(endpoint)) as robot,
        awareness.join(robot, "dröhne"),
        Program("gateway", "--port", "0", "-e", endpoint) as gateway,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
    ):
        for encoding in ("ascii", "latin-1", "utf-8"):
            code, out, _ = await shell(f"macs ls --json -e {endpoint}", PYTHONIOENCODING=encoding)
            assert (code, "dröhne" in {agent["name"] for agent in json.loads(out)}) == (0, True)
            code, _, _ = await shell(f"macs ls -e {endpoint}", PYTHONIOENCODING=encoding)
            assert code == 0
            listening = asyncio.create_task(
                shell(
                    f"macs headset 127.0.0.1:{gateway.port} --group 9 listen --from unity --count 1",
                    PYTHONIOENCODING=encoding,
                )
            )
            while not listening.done():
                await headset.send("grün".encode(), to=2, groups=[9])
                await asyncio.sleep(0.1)
            code, out, _ = listening.result()
            assert (code, json.loads(out)["text"]) == (0, "grün")
