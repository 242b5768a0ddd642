"""ROS interface packages built with pip's ROS only: hashes, two processes, packages of one's own, clear errors."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from as2_ca_msgs.msg import InterAgentMessage

from bridge.interfaces import Package, build
from macs_zenoh.errors import ConfigError, Unreachable
from tests.support.processes import ROOT
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, get, until

AS2_CA_MSGS = ROOT / "interfaces" / "as2_ca_msgs"

HASHES = {
    "as2_ca_msgs/msg/InterAgentMessage": "RIHS01_7d534e45e296e102004723ad6e107835afd52e08e3d29109614e34a2cc2b407f",
    "as2_ca_msgs/msg/LocalGenericMessage": "RIHS01_c745dfa3c0f867e44d9d7ff67a43034571a3ede429cbe8d086578d54e5ae2ec4",
    "as2_ca_msgs/srv/RegisterModule": "RIHS01_64f5dd3a5bbe002d0a19ea564d2c0372bcc3ca08a92e60ea59edf02798978170",
}
"""As every ROS 2 Jazzy computes them from as2_ca's definitions: with others, DDS would not match."""


def package(folder: Path, name: str = "own_msgs", **files: str) -> Path:
    """Write an interface package; files are named ``msg_Pose="float64 x"``."""
    folder.mkdir(exist_ok=True)
    (folder / "package.xml").write_text(
        f"<package format='3'><name>{name}</name><version>1.2.3</version><description>Own</description>"
        "<depend>std_msgs</depend><depend>geometry_msgs</depend></package>"
    )
    for file, text in files.items():
        kind, _, stem = file.partition("_")
        (folder / kind).mkdir(exist_ok=True)
        (folder / kind / f"{stem}.{kind}").write_text(text)
    return folder


def run_python(program: str, *path: Path, env: dict[str, str] | None = None) -> str:
    """Run a program in a Python of its own; its output."""
    result = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path)), **(env or {})},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def unpack(wheel: Path, into: Path) -> Path:
    """The wheel's Python packages, importable from the folder."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(into)
    return into


def test_the_hashes_are_those_of_as2_ca(tmp_path: Path) -> None:
    """Built from the folder, each interface has the hash that ROS installations compute."""
    built = build(AS2_CA_MSGS, tmp_path)
    assert built.hashes == HASHES
    with zipfile.ZipFile(built.wheel) as archive:
        names = archive.namelist()
    assert "as2_ca_msgs/msg/__init__.py" in names
    assert sum(name.endswith(".so") for name in names) == 1


async def test_the_installed_package_is_that_one(domain: int) -> None:
    """What rclpy tells other programs of a topic of this type is the same hash."""
    peer = Peer(domain)
    try:
        await peer.publisher(InterAgentMessage, "/t")
        (info,) = await peer.session.run(lambda: peer.session.node.get_publishers_info_by_topic("/t"))
        assert str(info.topic_type) == "as2_ca_msgs/msg/InterAgentMessage"
        assert "RIHS01_" + info.topic_type_hash.value.hex() == HASHES["as2_ca_msgs/msg/InterAgentMessage"]
    finally:
        await asyncio.to_thread(peer.session.close)


RAW_PUBLISHER = """
import os, sys, rclpy
from as2_ca_msgs.msg import InterAgentMessage
from rclpy.serialization import serialize_message
rclpy.init()
node = rclpy.create_node("raw")
publisher = node.create_publisher(InterAgentMessage, "/raw", 10)
while not publisher.get_subscription_count():
    rclpy.spin_once(node, timeout_sec=0.05)
publisher.publish(serialize_message(InterAgentMessage(sender="a", receiver="b", type="t", data=list(range(256)))))
publisher.wait_for_all_acked()
rclpy.shutdown()
"""


async def test_raw_messages_between_two_processes(domain: int) -> None:
    """Bytes published in one process arrive typed in another, field for field."""
    peer = Peer(domain)
    try:
        received = await peer.subscription(InterAgentMessage, "/raw")
        await asyncio.to_thread(run_python, RAW_PUBLISHER, env={"ROS_DOMAIN_ID": str(domain)})
        message = await get(received)
        assert (message.sender, message.receiver, message.type) == ("a", "b", "t")
        assert bytes(message.data) == bytes(range(256))
        await until(lambda: received.empty())
    finally:
        await asyncio.to_thread(peer.session.close)


OWN_TYPES = """
from own_msgs.msg import Part, Whole
from own_msgs.srv import Ask
from own_msgs.action import Do
from rclpy.serialization import deserialize_message, serialize_message
whole = Whole(name="Ω", parts=[Part(x=1.5), Part(x=2.5)], fixed=[1, 2, 3])
whole.header.frame_id = "map"
whole.poses[1].position.z = 7.0
back = deserialize_message(serialize_message(whole), Whole)
assert back == whole, back
assert Whole.LIMIT == 9 and Part().x == 0.5
Ask.Request(question="why"); Ask.Response(answer=42); Do.Goal(times=3); Do.Feedback(done=1)
import rclpy
rclpy.init()
node = rclpy.create_node("own")
node.create_service(Ask, "ask", lambda request, response: response)
node.create_publisher(Whole, "whole", 10)
from rclpy.action import ActionClient
ActionClient(node, Do, "do")
print("all there")
rclpy.shutdown()
"""


def test_a_package_of_ones_own(tmp_path: Path, domain: int) -> None:
    """Messages in messages, other packages' types, arrays, constants, defaults, a service and an action all work."""
    folder = package(
        tmp_path / "own",
        msg_Part="float64 x 0.5\n",
        msg_Whole=(
            "int32 LIMIT=9\nstd_msgs/Header header\nstring name\nPart[] parts\nint16[3] fixed\n"
            "geometry_msgs/Pose[2] poses\nbuiltin_interfaces/Time stamp\n"
        ),
        srv_Ask="string question\n---\nint32 answer\n",
        action_Do="int32 times\n---\nint32 done\n---\nint32 done\n",
    )
    built = build(folder, tmp_path)
    assert built.wheel.name.startswith("own_msgs-1.2.3-cp3")
    assert set(built.hashes) >= {"own_msgs/msg/Whole", "own_msgs/srv/Ask", "own_msgs/action/Do"}
    env = {"ROS_DOMAIN_ID": str(domain)}
    assert run_python(OWN_TYPES, unpack(built.wheel, tmp_path / "here"), env=env).strip() == "all there"


@pytest.mark.parametrize(
    ("files", "problem"),
    [
        ({}, "there is no msg"),
        ({"msg_Bad": "float64"}, "ROS does not accept it"),
        ({"msg_Bad": "nowhere_msgs/Thing thing"}, "ROS does not accept it"),
        ({"msg_lower": "int8 x"}, "ROS does not accept it"),
    ],
)
def test_what_is_no_interface_package(tmp_path: Path, files: dict[str, str], problem: str) -> None:
    """A folder without definitions, and definitions that ROS does not know, are errors of one line."""
    with pytest.raises(ConfigError, match=problem) as error:
        build(package(tmp_path / "own", **files), tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["", "Own", "own-msgs", "_own", "own__msgs", "9own"])
def test_names_that_ros_does_not_allow(tmp_path: Path, name: str) -> None:
    """A package's name is checked before anything is written."""
    with pytest.raises(ConfigError, match="not the name of a ROS package"):
        Package.read(package(tmp_path / "own", name, msg_A="int8 x"))


def test_without_a_manifest(tmp_path: Path) -> None:
    """A folder without package.xml, or with one that is none, says so."""
    with pytest.raises(ConfigError, match=r"package.xml.*an interface package has one"):
        build(tmp_path, tmp_path)
    (tmp_path / "package.xml").write_text("<package")
    with pytest.raises(ConfigError, match="not XML"):
        build(tmp_path, tmp_path)


def test_without_a_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is no g++, the first thing said is how to get one."""
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(Unreachable, match=r"g\+\+ cannot be reached: it is not installed.*sudo apt install g\+\+"):
        build(AS2_CA_MSGS, tmp_path)


async def test_the_command(tmp_path: Path) -> None:
    """`macs interfaces build --json` names the wheel and the hashes; a wrong folder ends with exit code 2."""
    folder = package(tmp_path / "own", msg_A="int8 x")
    for path, code in ((folder, 0), (tmp_path, 2)):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "bridge", "interfaces", "build", str(path), "--into", str(tmp_path), "--json"),
            cwd=ROOT,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        out, _log = await asyncio.wait_for(process.communicate(), 60)
        assert process.returncode == code
        if not code:
            answer = json.loads(out)
            assert list(answer["hashes"]) == ["own_msgs/msg/A"]
            assert Path(answer["wheel"]).is_file()


async def test_without_the_interfaces_awareness_says_what_to_do() -> None:
    """`macs awareness` where as2_ca_msgs cannot be imported ends with one line of advice, not a traceback."""
    program = (
        "import sys; sys.modules['as2_ca_msgs'] = None; from bridge.cli import main; sys.exit(main(['awareness']))"
    )
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", program), cwd=ROOT, stderr=asyncio.subprocess.PIPE
    )
    _, log = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert process.returncode == 1
    assert "macs interfaces build as2_ca_msgs --install" in log.decode()
    assert "Traceback" not in log.decode()


@pytest.mark.parametrize("files", [{"msg_Ask": "int32 from"}, {"srv_Ask": "string name\n---\nbool class"}])
def test_a_package_that_python_cannot_import_is_refused(tmp_path: Path, files: dict[str, str]) -> None:
    """A field named like a word of Python's is told with its definition, and no wheel is written."""
    with pytest.raises(ConfigError, match=r"ask is of no use in Python: .*a field may not be named (from|class)"):
        build(package(tmp_path / "own_msgs", **files), tmp_path / "wheels")
    assert not list(tmp_path.rglob("*.whl"))
