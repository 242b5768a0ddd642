"""The shipped configuration, every file of it: routers load it, programs accept it, units and containers start what
exists. A file in config/ that no test here knows fails the first one."""

from __future__ import annotations

import asyncio
import configparser
import datetime as dt
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml
import zenoh

import macs_zenoh
from bridge.cli import build_parser
from bridge.headset.client import Headset
from bridge.security import policy
from bridge.security.generate import generate
from bridge.settings import Settings, load
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from macs_zenoh.sections import changed
from tests.support.programs import ROOT, Program, free_port
from tests.support.routers import Router
from tests.support.tools import zenohd
from tests.support.waiting import PATIENCE_S, until

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CONFIG = ROOT / "config"
FILES = sorted(path for path in CONFIG.rglob("*") if path.is_file() and "__pycache__" not in path.parts)

ROUTERS = [path for path in FILES if path.suffix == ".json5"]
SETTINGS = [path for path in FILES if path.suffix == ".toml"]
PLANS = [path for path in FILES if path.suffix == ".yaml" and path.name != "compose.yaml"]
COMPOSED = [path for path in FILES if path.name == "compose.yaml"]
UNITS = [path for path in FILES if path.suffix == ".service"]
IMAGES = [
    path for path in FILES if re.fullmatch(r"Dockerfile(\.[a-z]+)?", path.name) and path.suffix != ".dockerignore"
]
IGNORES = [path for path in FILES if path.suffix == ".dockerignore"]
KERNEL = [path for path in FILES if path.suffix == ".conf" and path.parent.name == "wan"]
CORES = [CONFIG / "tmpfiles.d" / "macs-cpu-latency.conf", CONFIG / "tuned" / "macs" / "tuned.conf"]
FIGURES = [path for path in FILES if path.parent.name in ("grafana", "prometheus")]
"""In tests/unit/test_metrics.py."""
LAYOUTS = [CONFIG / "foxglove-demo.json"]
"""In tests/ros/test_foxglove.py."""
LAUNCH = [CONFIG / "robot.launch.py"]
"""In tests/ros/test_parameters.py."""

# Each router of a deployment, and settings of programs that connect to it: both ends of a link need the same values.
ENDS = {
    "one-host/router.json5": ["one-host/gateway.toml", "one-host/robot.toml"],
    "site/router-a.json5": ["site/gateway.toml", "site/robot.toml"],
    "site/router-b.json5": ["site/gateway.toml", "site/robot.toml"],
}


def ids(path: Path) -> str:
    return str(path.relative_to(CONFIG))


def test_every_file_is_tested() -> None:
    """Each shipped file is of a kind that a test here loads."""
    known = [
        *ROUTERS,
        *SETTINGS,
        *PLANS,
        *COMPOSED,
        *UNITS,
        *IMAGES,
        *IGNORES,
        *KERNEL,
        *CORES,
        *LAUNCH,
        *LAYOUTS,
        *FIGURES,
    ]
    assert sorted(known) == FILES


# -- routers -----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(zenohd() is None, reason="zenohd is not installed")
@pytest.mark.parametrize("path", ROUTERS, ids=ids)
async def test_zenohd_runs_it(path: Path) -> None:
    """zenohd starts with the file, without a warning about what it says, and takes sessions."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with Router(path, listen=[endpoint]) as router:
        await a_session(endpoint)
        assert not [line for line in router.log if "config" in line.lower() and "WARN" in line]


@pytest.mark.parametrize("path", ROUTERS, ids=ids)
async def test_macs_router_runs_it(path: Path) -> None:
    """The same router out of the Python package does as well."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with Program("router", "-c", str(path), "-l", endpoint):
        await a_session(endpoint)


async def a_session(endpoint: str) -> None:
    async with await Mesh.open(MeshSettings(connect=[endpoint])) as mesh:
        await until(lambda: mesh.linked)


@pytest.mark.parametrize("router", ENDS)
def test_a_router_has_the_values_of_its_programs(router: str) -> None:
    """Whatever our programs set on their end of a link, the router's file sets on the other; nothing has drifted."""
    written = zenoh.Config.from_file(str(CONFIG / router))
    for settings in ENDS[router]:
        agree(written, load(CONFIG / settings).mesh)
    assert json.loads(written.get_json("mode")) == "router"
    assert json.loads(written.get_json("adminspace")) == {
        "enabled": True,
        "permissions": {"read": True, "write": False},
    }


def agree(router: zenoh.Config, program: MeshSettings) -> None:
    """Whatever a program sets for its links, the router's file has, but for who it is and where it is."""
    for path, json5, _ in changed(program, mode="router").zenoh():
        if path not in ("mode", "connect/endpoints", "listen/endpoints"):
            expected = zenoh.Config()
            expected.insert_json5(path, json5)
            assert router.get_json(path) == expected.get_json(path), path


@pytest.mark.parametrize("path", PLANS, ids=ids)
def test_both_ends_of_generated_links_agree(path: Path, tmp_path: Path) -> None:
    """What is generated for the routers of a policy has the values of what is generated for its programs."""
    read = policy.load(path)
    generate(read, tmp_path, dt.datetime.now(dt.timezone.utc))
    for router in read.routers:
        written = zenoh.Config.from_file(str(tmp_path / router.name / "router.json5"))
        for client in read.clients:
            agree(written, load(tmp_path / client.name / "macs.toml").mesh)


async def test_a_site_works_on_either_router(tmp_path: Path) -> None:
    """The site's files with other ports: robot and gateway meet over both routers, and over one when one is killed."""
    ports = {name: free_port() for name in ("router-a", "router-b")}

    def placed(name: str) -> Path:
        text = (CONFIG / "site" / name).read_text(encoding="utf-8")
        for router, port in ports.items():
            text = text.replace(f"tcp/{router}:7447", f"tcp/127.0.0.1:{port}")
        path = tmp_path / name
        path.write_text(text.replace("tcp/[::]:7447", f"tcp/127.0.0.1:{ports.get(path.stem, 0)}"), encoding="utf-8")
        return path

    robot = load(placed("robot.toml"))
    at_port = ["--host", "127.0.0.1", "--port", "0"]
    async with AsyncExitStack() as stack:
        routers = [await stack.enter_async_context(Router(placed(f"{name}.json5"))) for name in ports]
        gateway = await stack.enter_async_context(
            Program("gateway", "--settings", str(placed("gateway.toml")), *at_port)
        )
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        agent = await stack.enter_async_context(
            macs_zenoh.join("ros", id=robot.robot.id, group=robot.robot.group, settings=robot.mesh)
        )
        await asyncio.wait_for(meet(headset, agent), PATIENCE_S)
        for router in routers:
            await router.stop(signal.SIGKILL)
            await asyncio.wait_for(meet(headset, agent), PATIENCE_S)
            await router.start()
            await asyncio.wait_for(meet(headset, agent), PATIENCE_S)


async def meet(headset: Headset, robot: macs_zenoh.Agent) -> None:
    """Until a message of the headset to the robot's group has arrived."""
    arrives = asyncio.ensure_future(robot.receive())
    while not arrives.done():
        await headset.send(b"hello", to=1, groups=[robot.group], manager="Greeting")
        await asyncio.wait([arrives], timeout=0.05)


# -- settings and policies ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", SETTINGS, ids=ids)
def test_programs_accept_it(path: Path) -> None:
    """Each settings file has known names and values within their ranges, and says something, but for the full list."""
    assert (load(path) == Settings()) == (path == CONFIG / "macs.toml")


@pytest.mark.parametrize("path", PLANS, ids=ids)
def test_a_plan_is_one(path: Path) -> None:
    """`macs security generate` takes it."""
    assert policy.load(path).routers


# -- systemd -----------------------------------------------------------------------------------------------------


def unit(path: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(path, encoding="utf-8")
    return parser


def command_of(path: Path) -> list[str]:
    """The program that a unit ends up as: without the shell that prepares it, with the unit's own environment."""
    text = path.read_text(encoding="utf-8")
    words = shlex.split(unit(path)["Service"]["ExecStart"])
    if words[0].endswith("bash"):
        words = shlex.split(words[2].rpartition("exec ")[2].replace("$$", "$"))
    own = dict(re.findall(r"^Environment=(\w+)=(.*)$", text, re.MULTILINE))
    return [value for word in words if (value := re.sub(r"\$\{?(\w+)\}?", lambda name: own[name[1]], word))]


@pytest.mark.parametrize("path", UNITS, ids=ids)
def test_a_unit_starts_what_exists(path: Path) -> None:
    """Its command is a verb with options that there are, or zenohd with its configuration."""
    program, *argv = command_of(path)
    if program == "/usr/bin/zenohd":
        assert argv == ["-c", "/etc/macs/router.json5"]
    else:
        assert program == "/opt/macs/bin/macs"
        accepted(argv)


@pytest.mark.parametrize("path", UNITS, ids=ids)
def test_a_unit_falls_into_no_trap(path: Path) -> None:
    """It is ordered after the network and makes it come up, is started again for ever, depends on no unit of ours, and
    runs as a user without rights."""
    parsed = unit(path)
    assert parsed["Unit"]["After"] == parsed["Unit"]["Wants"] == "network-online.target"
    assert parsed["Unit"]["StartLimitIntervalSec"] == "0"
    assert not {"Requires", "Requisite", "BindsTo", "PartOf"} & set(parsed["Unit"])
    service = parsed["Service"]
    assert (service["Restart"], service["User"], service["ProtectSystem"]) == ("always", "macs", "strict")
    assert (service["NoNewPrivileges"], service["CapabilityBoundingSet"]) == ("true", "")
    assert parsed["Install"]["WantedBy"] == "multi-user.target"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
@pytest.mark.parametrize("path", UNITS, ids=ids)
def test_systemd_accepts_a_unit(path: Path, tmp_path: Path) -> None:
    """systemd knows every line of it; its programs are not installed here, so another stands in for them."""
    copy = tmp_path / path.name
    text = path.read_text(encoding="utf-8")
    text = re.sub(r"(?<=ExecStart=)/(opt/macs/bin/macs|usr/bin/zenohd)\b", "/bin/true", text)
    copy.write_text(text, encoding="utf-8")
    verify = ["systemd-analyze", "verify", "--man=no", str(copy)]
    done = subprocess.run(verify, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_both_files_for_cores_ask_for_the_same() -> None:
    """tuned and systemd-tmpfiles are told the same latency, in lines that they know."""
    tuned = configparser.ConfigParser()
    tuned.read(CORES[1], encoding="utf-8")
    text = CORES[0].read_text(encoding="utf-8")
    [line] = [line.split() for line in text.splitlines() if not line.startswith("#")]
    assert line[0] == "w"
    assert line[1].endswith("/power/pm_qos_resume_latency_us")
    assert line[2:] == ["-", "-", "-", "-", tuned["cpu"]["force_latency"]]


@pytest.mark.parametrize("path", KERNEL, ids=ids)
def test_the_kernel_has_what_is_set(path: Path) -> None:
    """Each line sets something that there is; of a namespace's own kernel settings only the IP ones are visible."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    assert lines
    for line in lines:
        name, _, value = line.partition(" = ")
        assert value
        assert Path("/proc/sys", *name.split(".")).exists() or not name.startswith("net.ipv4."), name


# -- containers --------------------------------------------------------------------------------------------------


def services(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    yield from yaml.safe_load(path.read_text(encoding="utf-8"))["services"].items()


@pytest.mark.parametrize("path", COMPOSED, ids=ids)
def test_a_compose_file_starts_what_exists(path: Path) -> None:
    """Each service runs a verb with options that there are, on files and images that there are."""
    for name, service in services(path):
        accepted([str(word) for word in service["command"]])
        build = service["build"]
        assert (path.parent / build["context"]).resolve() == ROOT, name
        assert ROOT / build["dockerfile"] in IMAGES, name
        (volume,) = service["volumes"]
        source, target, mode = volume.split(":")
        assert (target, mode) == ("/etc/macs", "ro")
        if source == ".":  # otherwise what was generated for the machine
            for word in service["command"]:
                if str(word).startswith("/etc/macs/"):
                    assert (path.parent / str(word).removeprefix("/etc/macs/")).is_file(), word


@pytest.mark.parametrize("path", COMPOSED, ids=ids)
def test_a_compose_file_falls_into_no_trap(path: Path) -> None:
    """Services come back, get signals, keep bounded logs, have no rights, and see the machine's own network."""
    for name, service in services(path):
        assert service["restart"] == "unless-stopped", name
        assert service["init"] is True, name
        assert service["network_mode"] == "host", name
        assert service["logging"]["options"]["max-size"], name
        assert (service["cap_drop"], service["read_only"]) == (["ALL"], True), name
        assert "depends_on" not in service, name
        if service["command"][0] == "agent":
            assert service["environment"]["FASTDDS_BUILTIN_TRANSPORTS"] == "UDPv4"
            assert service["environment"]["ROS_LOG_DIR"] in service["tmpfs"]


@pytest.mark.parametrize("path", IMAGES, ids=ids)
def test_an_image_is_made_of_what_exists(path: Path) -> None:
    """What it copies is there and not ignored, and all that the package's build reads is copied; it runs `macs`."""
    lines = re.sub(r"\\\n", " ", path.read_text(encoding="utf-8")).splitlines()
    steps = [line.split(maxsplit=1) for line in lines if line and not line.startswith("#")]
    copied = {
        word for step, rest in steps if step == "COPY" and not rest.startswith("--from") for word in rest.split()[:-1]
    }
    ignored = Path(f"{path}.dockerignore").read_text(encoding="utf-8").splitlines()
    assert {f"!{name}" for name in copied} == {line for line in ignored if line.startswith("!")}
    assert [name for name in copied if not (ROOT / name).exists()] == []
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = {pattern.rstrip("*") for pattern in project["tool"]["setuptools"]["packages"]["find"]["include"]}
    links = {os.path.relpath(link.resolve(), ROOT) for link in (ROOT / "bridge" / "data").iterdir()}
    assert {*packages, *links, "pyproject.toml", "setup.py", "README.md"} <= copied
    (install,) = re.findall(r"pip install --no-cache-dir (\S+)", path.read_text(encoding="utf-8"))
    extras = re.findall(r"\w+", install)
    assert set(extras) <= set(project["project"]["optional-dependencies"])
    entry = next(json.loads(rest) for step, rest in steps if step == "ENTRYPOINT")
    assert entry[-1] == "/opt/macs/bin/macs"
    assert "USER macs" in lines


def accepted(argv: list[str]) -> None:
    """`macs` takes these words."""
    assert build_parser().parse_args(argv).verb == argv[0]
