"""The worked example of docs/managers.md as it stands there: its settings, a gateway process, bytes on a socket."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shlex
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec import Struct

import macs_zenoh
import macs_zenoh.managers
from bridge.gateway import Gateway
from bridge.settings import GatewaySettings
from macs_zenoh.errors import Refused
from macs_zenoh.managers import Asker, Manager
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import type_number
from macs_zenoh.protocol.messages import Metadata, decode_data, encode_data
from macs_zenoh.protocol.wire import encode_frame, encode_message
from tests.support.local import patient
from tests.support.programs import ROOT, Program, ended, free_port, macs
from tests.support.sockets import Socket, socket
from tests.support.waiting import PATIENCE_S, until

EXAMPLES = ROOT / "examples"
PAGE = (ROOT / "docs" / "managers.md").read_text(encoding="utf-8")


def asking(text: str, request_id: int = 7) -> bytes:
    """A frame with this management data, and the request id by which the asker knows the answer."""
    metadata = json.dumps({"requestId": request_id}).encode()
    return encode_frame(management=text.encode(), message=encode_message(metadata))


async def ask(agent: Socket, text: str) -> dict[str, object]:
    """Send management data; the JSON of the answer."""
    agent.writer.write(asking(text))
    metadata, body = await agent.message()
    assert (metadata.request_id, metadata.message_manager, metadata.node_name) == (7, "", "")
    return json.loads(body)


def code(name: str) -> str:
    """The code block of the page that stands for this file."""
    block = re.search(rf"`{re.escape(name)}`[^\n]*\n\n```\w+\n(.*?)```", PAGE, re.DOTALL)
    assert block is not None, name
    return block[1]


@pytest.mark.parametrize("name", ["examples/macs_clock/clock_comparer.py", "examples/macs_clock/macs.toml"])
def test_the_page_shows_the_example(name: str) -> None:
    """The code on the page is the code in the files, without what only a file needs."""
    text = (ROOT / name).read_text(encoding="utf-8")
    shown = [line for line in code(name).splitlines() if line.strip()]
    lines = iter(text.splitlines())
    assert all(line in lines for line in shown)


def test_the_page_shows_the_entry_point() -> None:
    """The lines of the page that offer the example are those of its package."""
    assert code("examples/pyproject.toml").strip() in (EXAMPLES / "pyproject.toml").read_text(encoding="utf-8")


@asynccontextmanager
async def gateway_process(*argv: str, env: dict[str, str]) -> AsyncIterator[Program]:
    """A router, and a gateway that finds the examples."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with (
        Program("router", "-l", endpoint),
        Program("gateway", "--port", "0", "-e", endpoint, *argv, env=env) as gateway,
    ):
        yield gateway


async def test_the_worked_example() -> None:
    """`macs gateway --settings` with the example's file answers the page's frame with the typed answer; what is wrong
    with a question costs that question."""
    settings = str(EXAMPLES / "macs_clock" / "macs.toml")
    env = {"PYTHONPATH": str(EXAMPLES)}
    async with (
        gateway_process("--settings", settings, env=env) as program,
        socket(SimpleNamespace(port=program.port)) as agent,  # type: ignore[arg-type]
    ):
        agent.configure()
        before = time.time()
        answer = await ask(agent, code("management data").strip())
        assert before - 1 < answer.pop("receivedAtS") < time.time() + 1
        assert answer == {"sentAtS": 1760000000.25, "asker": f"2/{agent.id}"}

        agent.writer.write(asking('{"messageManager": "ClockComparer", "sentAtS": -1}'))
        agent.writer.write(asking('{"messageManager": "ClockComparer", "sentAtS": "noon"}'))
        agent.writer.write(asking('{"messageManager": "ClockComparer"}'))
        assert (await ask(agent, '{"message_manager": "ClockComparer", "sent_at_s": 2}'))["sentAtS"] == 2
        for said in ("ClockComparer: -1.0 is not a time", "Expected `float`, got `str`"):
            await until(lambda said=said: any(said in line for line in program.log))


async def test_the_worked_example_from_the_command_line() -> None:
    """The page's command prints the answer; what is refused or has no manager is exit code 1, no JSON is 2."""
    settings = str(EXAMPLES / "macs_clock" / "macs.toml")
    (line,) = re.findall(r"^macs headset 127\.0\.0\.1:7000 (ask .*)$", PAGE, re.MULTILINE)
    async with gateway_process("--settings", settings, env={"PYTHONPATH": str(EXAMPLES)}) as program:
        where = f"127.0.0.1:{program.port}"
        said = await macs("headset", where, *shlex.split(line))
        assert (said["manager"], said["from"], said["answer"]["sentAtS"]) == (
            "ClockComparer",
            "gateway",
            1760000000.25,
        )
        for words, why in (
            (("ClockComparer", '{"sentAtS": -1}'), "-1.0 is not a time"),
            (("NobodysManager",), f"NobodysManager of gateway {where} cannot be reached: no answer within 0.5 s"),
        ):
            code, out, errors = await ended("headset", where, "ask", *words, "--timeout", "0.5")
            assert (code, out) == (1, "")
            assert why in errors
        code, out, errors = await ended("headset", where, "ask", "ClockComparer", "{")
        assert (code, out) == (2, "")


async def test_an_installed_package_offers_its_manager(tmp_path: Path) -> None:
    """A package with the page's entry point needs no settings."""
    info = tmp_path / "macs_clock-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: macs-clock\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[macs.managers]\nclock = macs_clock.clock_comparer:ClockComparer\n")
    env = {"PYTHONPATH": os.pathsep.join([str(EXAMPLES), str(tmp_path)])}
    async with (
        gateway_process(env=env) as program,
        socket(SimpleNamespace(port=program.port)) as agent,  # type: ignore[arg-type]
    ):
        agent.configure()
        assert (await ask(agent, '{"messageManager":"ClockComparer","sentAtS":1}'))["sentAtS"] == 1


async def test_a_wrong_settings_file_stops_the_start(tmp_path: Path) -> None:
    """A manager that breaks the naming rule is told with its line, and the gateway exits with 2."""
    (tmp_path / "clock.py").write_text((EXAMPLES / "macs_clock" / "clock_comparer.py").read_text())
    (tmp_path / "macs.toml").write_text('[gateway]\nport = 0\nmanagers = ["clock:ClockComparer"]\n')
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "bridge",
        "gateway",
        "--settings",
        str(tmp_path / "macs.toml"),
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        stderr=asyncio.subprocess.PIPE,
    )
    _, errors = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert (process.returncode, "ClockComparer must live in a module called clock_comparer" in errors.decode()) == (
        2,
        True,
    )


class Unspeakable(Struct):
    """What JSON cannot hold."""

    it: object


class Moody(Manager):
    """Does what its data says."""

    class Data(Struct):
        """What to do."""

        mood: str

    def manage(self, data: Data, asker: Asker) -> Struct | None:
        """Answer, refuse, fail, or answer with what JSON cannot hold."""
        if data.mood == "refuse":
            raise Refused("not today")
        if data.mood == "fail":
            raise ZeroDivisionError
        if data.mood == "unspeakable":
            return Unspeakable(object())
        return None if data.mood == "silent" else data


@asynccontextmanager
async def moody_gateway(router: str) -> AsyncIterator[Gateway]:
    """A gateway in this process with the manager above."""
    async with await Mesh.open(patient(router)) as mesh:
        gateway = Gateway(mesh, GatewaySettings(port=0), {"Moody": Moody()})
        await gateway.start()
        try:
            yield gateway
        finally:
            await gateway.close()


@pytest.mark.parametrize(
    ("mood", "counter"),
    [
        ("refuse", "refused_by_manager"),
        ("fail", "manager_failed"),
        ("silent", ""),
        ("unspeakable", "manager_failed"),
    ],
)
async def test_a_manager_without_an_answer(mood: str, counter: str, router: str) -> None:
    """A manager that refuses or fails is counted and costs that message; the connection and the manager go on."""
    async with moody_gateway(router) as gateway, socket(gateway) as agent:
        agent.configure()
        agent.writer.write(asking(json.dumps({"messageManager": "Moody", "mood": mood})))
        assert await ask(agent, '{"messageManager":"Moody","mood":"good"}') == {"mood": "good"}
        connection = gateway.agents.find(2, agent.id)
        assert connection.all_drops() == ({counter: 1} if counter else {})


async def test_a_name_in_a_message_imports_nothing(router: str) -> None:
    """Whatever a message names, no module comes into the program, and the agent goes on."""
    async with moody_gateway(router) as gateway, socket(gateway) as agent:
        agent.configure()
        await agent.online()
        before = set(sys.modules)
        names = ["os.path", "subprocess", "antigravity", "xmlrpc.server", "moody", "macs_clock.clock_comparer"]
        for name in names:
            agent.writer.write(asking(json.dumps({"messageManager": name})))
            agent.writer.write(asking(json.dumps({"messageManager": f"{name}:ClockComparer"})))
        assert await ask(agent, '{"messageManager":"Moody","mood":"good"}') == {"mood": "good"}
        assert set(sys.modules) - before == set()
        connection = gateway.agents.find(2, agent.id)
        assert connection.all_drops()["UnknownManager"] == 2 * len(names)


async def test_a_manager_waits_for_the_configuration(router: str) -> None:
    """A question that comes before the configuration is answered after it, for the agent that the connection is."""
    async with moody_gateway(router) as gateway, socket(gateway) as agent:
        agent.writer.write(asking('{"messageManager":"Moody","mood":"early"}'))
        agent.configure()
        metadata, body = await agent.message()
        assert (metadata.request_id, json.loads(body)) == (7, {"mood": "early"})


async def test_a_manager_in_a_program_of_ones_own(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's loop answers a headset that sends a message to the program's id."""
    monkeypatch.syspath_prepend(EXAMPLES)
    (loop,) = re.findall(r"```python\n(managers = .*?)```", PAGE, re.DOTALL)
    lines = "".join(f"    {line}\n" for line in loop.splitlines())
    names = {"macs_zenoh": macs_zenoh, **{what.__name__: what for what in (decode_data, encode_data, type_number)}}
    names |= {"Asker": Asker, "Metadata": Metadata}
    exec(f"async def serve(agent):\n{lines}", names)
    async with (
        moody_gateway(router) as gateway,
        socket(gateway) as headset,
        macs_zenoh.join("ros", id=300, settings=patient(router)) as agent,
    ):
        serving = asyncio.create_task(names["serve"](agent))
        headset.configure()
        while 300 not in (await headset.online())[0]:
            await asyncio.sleep(0.01)
        metadata = json.dumps({"messageManager": "ClockComparer", "requestId": 9}).encode()
        headset.writer.write(encode_frame(1, (300,), message=encode_message(metadata, b'{"sentAtS":5}')))
        answered, body = await headset.message()
        assert (answered.request_id, answered.message_manager, answered.sender_agent_id) == (9, "", 300)
        assert json.loads(body)["asker"] == f"2/{headset.id}"
        serving.cancel()
