"""Parameters, launch file and unit: how a robot is started by ROS people."""

from __future__ import annotations

import ast
import configparser
import shlex
from pathlib import Path

import pytest

from bridge.cli import main
from bridge.ros import parameters
from bridge.ros.interface import Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.program import open_robot
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.settings import RobotSettings, Settings
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError
from tests.support.programs import Program, free_port

CONFIG = Path(__file__).parents[2] / "config"
BASE = Settings(mesh=MeshSettings(connect=["tcp/10.0.0.9:1"]), robot=RobotSettings(id=4, group=2))


@pytest.mark.parametrize(
    ("given", "connect", "robot"),
    [
        ({}, "tcp/10.0.0.9:1", (4, 2)),
        ({"router_ip_address": "10.0.0.1"}, "tcp/10.0.0.1:7447", (4, 2)),
        ({"router_port": "7000"}, "tcp/127.0.0.1:7000", (4, 2)),
        ({"router_ip_address": "fe80::1", "router_port": "7000"}, "tcp/[fe80::1]:7000", (4, 2)),
        ({"group_id": "3", "agent_id": "7"}, "tcp/10.0.0.9:1", (7, 3)),
        ({"group_id": "0"}, "tcp/10.0.0.9:1", (4, 0)),
    ],
)
async def test_parameters_win_over_settings(
    domain: int, given: dict[str, str], connect: str, robot: tuple[int, int]
) -> None:
    """Each parameter that is set has its effect, the others have none."""
    with RosSession(domain_id=domain, ros_args=_ros_args(given)) as session:
        settings = await session.run(lambda: parameters.apply(session.node, BASE))
    assert settings.mesh.connect == [connect]
    assert (settings.robot.id, settings.robot.group) == robot


@pytest.mark.parametrize("given", [{"router_port": "seven"}, {"router_port": "70000"}, {"group_id": "256"}])
async def test_a_wrong_parameter_is_an_error(domain: int, given: dict[str, str]) -> None:
    """The robot does not start, and says which parameter."""
    with pytest.raises(ConfigError, match=r"router_port|robot\.group"):
        async with open_robot(BASE, domain_id=domain, ros_args=_ros_args(given)):
            raise AssertionError("it started")


async def test_namespace_and_remapping_hold(domain: int) -> None:
    """The node has the name and namespace that ROS arguments give, and relative names follow."""
    ros_args = ["--ros-args", "-r", "__ns:=/robot7", "-r", "__node:=eyes", "-r", "cmd_vel:=/drive"]
    with RosSession(domain_id=domain, ros_args=ros_args) as session:
        assert session.full_name == "/robot7/eyes"
        assert session.node.resolve_topic_name("camera") == "/robot7/camera"
        assert session.node.resolve_topic_name("cmd_vel") == "/drive"


async def test_the_emergency_stop_is_open_wherever_it_is_remapped(domain: int) -> None:
    """Also with one topic exposed, for its own name and for the one it has in ROS; the rest stays closed."""
    ros_args = ["--ros-args", "-r", "/emergency_stop:=/robot7/emergency_stop"]
    with RosSession(domain_id=domain, ros_args=ros_args) as session:
        rules = Rules(RobotSettings(expose=["/cmd_vel"]))
        nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, rules=rules))
        try:
            await nodes.open_stop("/emergency_stop")
            assert nodes.stop is not None
            assert nodes.stop.topic == "/robot7/emergency_stop"
            names = ["/emergency_stop", "/robot7/emergency_stop", "/cmd_vel", "/scan"]
            assert [rules.exposes(name) for name in names] == [True, True, True, False]
        finally:
            nodes.close()


def test_the_launch_file_starts_what_exists() -> None:
    """It is valid Python, and every option and parameter in it is one that the agent has."""
    text = (CONFIG / "robot.launch.py").read_text()
    words = {node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Constant)}
    assigned = {str(word).removesuffix(":=") for word in words if str(word).endswith(":=")}
    assert assigned == {*parameters.TYPES, "__ns"}
    assert {"macs", "agent", "--settings", "--ros-args"} <= words


async def test_the_command_of_the_launch_file_starts_a_robot(domain: int, tmp_path: Path) -> None:
    """With the defaults of its arguments, besides where router and settings are, the agent is robot 1.

    ROS's launch is not on PyPI, so what it would put together is put together here, from the file's own expression.
    """
    tree = ast.parse((CONFIG / "robot.launch.py").read_text())
    (arguments,) = [node for node in ast.walk(tree) if isinstance(node, ast.Assign)][:1]
    (command,) = [node.value for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == "cmd"]
    port, settings = free_port(), tmp_path / "macs.toml"
    settings.touch()
    values = {name: default for name, (default, _) in ast.literal_eval(arguments.value).items()}
    values |= {"router_port": str(port), "settings": str(settings)}
    words = eval(compile(ast.Expression(command), "cmd", "eval"), {"value": values.__getitem__})
    argv = [word if isinstance(word, str) else "".join(word) for word in words]
    assert argv[0] == "macs"
    async with (
        Program("router", "-l", f"tcp/127.0.0.1:{port}"),
        Program(*argv[1:], env={"ROS_DOMAIN_ID": str(domain)}) as robot,
    ):
        assert robot.ready == "robot 1"


def test_the_unit_starts_what_exists(capsys: pytest.CaptureFixture[str]) -> None:
    """Its command is a verb with options that there are."""
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(CONFIG / "systemd" / "macs-robot.service")
    shell = shlex.split(unit["Service"]["ExecStart"])[2].replace("$$", "$")
    command = shlex.split(shell.rpartition("exec ")[2])[1:]
    with pytest.raises(SystemExit):
        main([*command, "--help"])
    assert "--settings" in capsys.readouterr().out


def _ros_args(given: dict[str, str]) -> list[str]:
    pairs = [["-p", f"{name}:={value}"] for name, value in given.items()]
    return ["--ros-args", *(word for pair in pairs for word in pair)] if pairs else []
