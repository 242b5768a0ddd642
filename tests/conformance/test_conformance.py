"""The conformance kit: right programs pass all of it, and each wrong one is found by the check meant for it."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import subprocess
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from xml.etree import ElementTree

import pytest

from bridge.conformance import gateway, headset
from bridge.conformance.checks import Outcome, Verdict
from bridge.headset.client import Headset
from tests.conformance import client_faults, router_faults
from tests.conformance.faults import Fault
from tests.conformance.proxy import Proxy
from tests.support.programs import ROOT, Program, ended, free_port
from tests.support.thorough import THOROUGH

PATIENCE_S = 8.0
"""As long as a loaded machine may take; right programs never use it."""
WRONG_PATIENCE_S = 3.0
"""For what wrong ones never do. What one of them only does too late counts as not done, as it may."""
SLOW = ("forgets_its_secret",)
"""It is waited for three minutes, the others for half a minute: among all examples only."""
OK = bytes.fromhex("0001000001000000030000006f6b00")
TRUE, HELLO = bytes.fromhex("0001000001"), bytes.fromhex("000100000600000068656c6c6f00")


class PythonHeadset:
    """Our headset in Python, doing all that the kit can judge, behind a proxy."""

    def __init__(self, fault: Fault | None = None) -> None:
        self._fault = fault or Fault("")
        self._stack = AsyncExitStack()
        self._doing: list[asyncio.Task[None]] = []

    async def start(self, port: int) -> None:
        await self.stop()
        proxy = await self._stack.enter_async_context(Proxy(port, self._fault.frame, self._fault.message))
        self._doing = [asyncio.create_task(self._live(proxy.port))]

    async def stop(self) -> bool:
        for task in self._doing:
            task.cancel()
            await asyncio.wait([task])
        await self._stack.aclose()
        return True

    async def _live(self, port: int) -> None:
        async def serve(request: bytes, *_: object) -> bytes:
            return OK

        robot = {"agents": [1]}
        async with await Headset.connect("127.0.0.1", port, reconnect=True) as one:
            await one.subscribe("/conformance/text", "std_msgs/String", callback=lambda message: None, **robot)
            await one.serve("/conformance/ask", "std_srvs/SetBool", serve, **robot)
            command = await one.advertise("/conformance/command", "std_msgs/String", **robot)
            await command.publish(HELLO, **robot)
            asking = asyncio.gather(
                one.online(), one.call("/conformance/set", "std_srvs/SetBool", 1, TRUE), return_exceptions=True
            )
            try:
                await asyncio.Event().wait()
            finally:
                asking.cancel()


def failed(verdicts: list[Verdict]) -> dict[str, str]:
    return {verdict.check.name: verdict.why for verdict in verdicts if verdict.outcome is Outcome.FAILED}


def skipped(verdicts: list[Verdict]) -> set[str]:
    """Why some were."""
    return {verdict.why for verdict in verdicts if verdict.outcome is Outcome.SKIPPED}


async def judged_headset(fault: Fault | None = None) -> list[Verdict]:
    program = PythonHeadset(fault)
    patience_s = WRONG_PATIENCE_S if fault else PATIENCE_S
    try:
        return await headset.judge("127.0.0.1", 0, patience_s=patience_s, most_s=150, program=program)
    finally:
        await program.stop()


@pytest.mark.timeout(500)
async def test_right_and_wrong_headsets_are_told_apart() -> None:
    """Our headset passes everything; with one fault of the table it fails the check that is meant for it."""
    names = [name for name in client_faults.FAULTS if name not in SLOW or os.environ.get(THOROUGH)]
    right, *wrong = await asyncio.gather(
        judged_headset(), *(judged_headset(client_faults.FAULTS[name]) for name in names)
    )
    assert failed(right) == {}
    assert [verdict.check.name for verdict in right if verdict.outcome is Outcome.SKIPPED] == []
    found = {name: (failed(verdicts), skipped(verdicts)) for name, verdicts in zip(names, wrong, strict=True)}
    missed = {name: seen for name, seen in found.items() if client_faults.FAULTS[name].found_by not in seen[0]}
    assert not missed, "\n".join(f"{name}: {seen}" for name, seen in missed.items())


@pytest.fixture
async def real_gateway():  # type: ignore[no-untyped-def]
    """A gateway of ours that lets robots in; its port."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with (
        Program("router", "-l", endpoint),
        Program("gateway", "--port", "0", "--robots", "any", "-e", endpoint) as one,
    ):
        yield one.port


async def judged_gateway(port: int, fault: Fault, group: int) -> list[Verdict]:
    async with Proxy(port, fault.frame, fault.message) as proxy:
        return await gateway.judge("127.0.0.1", proxy.port, patience_s=WRONG_PATIENCE_S, most_s=150, group=group)


@pytest.mark.timeout(500)
async def test_right_and_wrong_routers_are_told_apart(real_gateway: int) -> None:
    """Our gateway passes everything; with one fault of the table it fails the check that is meant for it."""
    right = await gateway.judge("127.0.0.1", real_gateway, patience_s=PATIENCE_S, most_s=150)
    assert failed(right) == {}
    assert [verdict.check.name for verdict in right if verdict.outcome is Outcome.SKIPPED] == []
    missed = {}
    names = list(router_faults.FAULTS)
    several = asyncio.Semaphore(3)

    async def judge(number: int, name: str) -> None:
        fault = router_faults.FAULTS[name]
        async with several:
            seen = failed(await judged_gateway(real_gateway, fault, 10 + 2 * number))
        if fault.found_by not in seen:
            missed[name] = seen

    await asyncio.gather(*(judge(number, name) for number, name in enumerate(names)))
    assert missed == {}


def test_there_are_enough_of_both() -> None:
    """A hundred checks and thirty faults, each of a check that exists; names are there once."""
    names = [check.name for check in (*gateway.CHECKS, *headset.CHECKS)]
    assert len(names) >= 100
    for checks in (gateway.CHECKS, headset.CHECKS):
        assert len({check.name for check in checks}) == len(checks)
    assert {fault.found_by for fault in router_faults.FAULTS.values()} <= {check.name for check in gateway.CHECKS}
    assert {fault.found_by for fault in client_faults.FAULTS.values()} <= {check.name for check in headset.CHECKS}
    assert len(router_faults.FAULTS) + len(client_faults.FAULTS) >= 30


async def test_the_command_judges_a_gateway(real_gateway: int, tmp_path: Path) -> None:
    """`macs conformance gateway` ends with 0, says so as JSON and as JUnit's XML, and in less than a minute."""
    report = tmp_path / "report.xml"
    code, out, errors = await ended(
        "conformance",
        "gateway",
        f"127.0.0.1:{real_gateway}",
        "--json",
        "--junit",
        str(report),
        "--level",
        "compatible",
        "--patience",
        str(PATIENCE_S),
    )
    assert code == 0, errors
    said = json.loads(out)
    assert said["failed"] == said["skipped"] == 0
    assert said["passed"] == len(said["checks"]) > 60
    assert said["seconds"] < 60
    suite = ElementTree.parse(report).getroot()
    assert (int(suite.get("tests", "")), suite.get("failures")) == (said["passed"], "0")


async def test_the_command_fails_where_nobody_is(tmp_path: Path) -> None:
    """A gateway that is not there is exit code 1, a target or command that is missing 2."""
    code, _, errors = await ended("conformance", "gateway", f"127.0.0.1:{free_port()}")
    assert (code, "cannot be reached" in errors) == (1, True)
    for argv in (["gateway"], ["headset"], ["headset", "--listen", "0", "--run", str(tmp_path / "nothing")]):
        code, _, errors = await ended("conformance", *argv)
        assert code == 2, errors


@pytest.mark.skipif(not (shutil.which("mcs") and shutil.which("mono")), reason="needs mono-mcs")
async def test_the_csharp_example_passes(tmp_path: Path) -> None:
    """The C# headset of examples/unity outlives everything, also what deafens the existing one."""
    program = tmp_path / "MacsHeadset.exe"
    source = str(ROOT / "examples" / "unity" / "MacsHeadset.cs")
    command = ["mcs", "-warnaserror", "-r:System.Runtime.Serialization", f"-out:{program}", source]
    assert subprocess.run(command, check=False).returncode == 0
    run = f"mono {program} 127.0.0.1 {{port}} 200"
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "bridge", "conformance", "headset", "--listen", "0", "--run", run, "--json"),
        *("--patience", str(PATIENCE_S)),
        cwd=ROOT,
        stdout=asyncio.subprocess.PIPE,
    )
    out, _ = await process.communicate()
    said = json.loads(out)
    assert {check["name"]: check["why"] for check in said["checks"] if check["outcome"] == "failed"} == {}
    assert (process.returncode, said["passed"] > 90) == (0, True)
