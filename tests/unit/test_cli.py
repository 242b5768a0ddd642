"""The command line: help, exit codes, how options, files and the environment become settings, and the key map."""

from __future__ import annotations

import argparse
import io
import json
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from bridge.cli import VERBS, build_parser, doctor, ls, main, options, robots, stop, supervisor, terminal, up
from bridge.doctor.checks import Severity
from bridge.doctor.facts import Facts, Own
from bridge.doctor.findings import found
from bridge.headset.verbs import script_parser
from bridge.settings import OperatorSettings, Settings
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, UsageError
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.keyexpr import KEYS
from macs_zenoh.protocol.named import Named
from macs_zenoh.protocol.ping import Pong
from macs_zenoh.protocol.robot_state import RobotStatus


def parsed(*argv: str) -> argparse.Namespace:
    return build_parser().parse_args(argv)


# -- help and errors -------------------------------------------------------------------------------------------------


def test_help_names_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    """`macs --help` has a line for each verb, and examples."""
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    width = max(map(len, VERBS)) + 2
    for verb, module in VERBS.items():
        assert f"    {verb:{width}}{module.SUMMARY}" in shown
    assert shown.count("\n  macs ") == 3
    assert "Exit codes: 0 done; 1 " in shown


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb_has_examples(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each verb explains itself and shows how it is called."""
    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert f"\n  macs {verb}" in shown or f"$(macs {verb}" in shown
    assert re.search(r"(?i)^what it prints", shown, re.MULTILINE)
    assert max(len(line) for line in shown.splitlines()) < 120


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["fly"],
        ["gateway", "--port", "many"],
        ["up", "--once"],
        ["gateway", "--port", "70000"],
        ["agent", "--id", "0"],
        ["gateway", "-e", "10.0.0.1:7447"],
        ["router", "--cfg", "mode"],
        ["ls", "--settings", "/nowhere/macs.toml"],
        ["ls", "--as", "nobody"],
        ["ls", "--as", "operator/70000"],
        ["stop", "0"],
        ["stop", "--group", "all"],
        ["stop", "7", "--all"],
        ["stop", "--release"],
    ],
    ids=" ".join,
)
def test_wrong_usage_is_one_line_and_exit_code_2(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """What the user wrote wrong is told in one line, without a traceback."""
    try:
        code = main(argv)
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    assert code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Traceback" not in captured.err
    assert captured.err.strip().splitlines()[-1].startswith("macs")


@pytest.mark.parametrize(
    ("argv", "verb", "meant"),
    [
        (["agnet"], "macs", "invalid choice: 'agnet', did you mean agent?"),
        (["ls", "--jsno"], "macs ls", "unrecognized arguments: --jsno, did you mean --json?"),
        (["ls", "--timeuot=5"], "macs ls", "did you mean --timeout?"),
        (["ls", "all"], "macs ls", "unrecognized arguments: all"),
        (["gateway", "--prot", "7000"], "macs gateway", "did you mean --port?"),
        (["router", "--frobnicate"], "macs router", "unrecognized arguments: --frobnicate"),
        (["security", "chekc"], "macs security", "did you mean check?"),
        (["headset", "127.0.0.1", "snd"], "macs headset 127.0.0.1", "did you mean send?"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_a_misspelled_word_is_told_by_its_verb(
    argv: list[str], verb: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """What a verb does not know is told with that verb's usage, and with what may have been meant."""
    with pytest.raises(SystemExit) as ended:
        main(argv)
    assert ended.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[0].startswith(f"usage: {verb.partition(' 127')[0]} ")
    assert lines[-1].startswith(f"{verb.partition(' 127')[0]}")
    assert lines[-1].endswith(meant)


@pytest.mark.parametrize("word", ["tops", "sop", "shop", "step", "stopp", "sto", "stp", "Stop"])
def test_stop_is_never_offered_for_another_word(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Who misspells a verb is never led to the one that stops every robot."""
    with pytest.raises(SystemExit) as ended:
        main([word])
    assert ended.value.code == 2
    assert "did you mean stop" not in capsys.readouterr().err


def parsers_below(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from parsers_below(below)


@pytest.mark.parametrize("top", [build_parser, script_parser])
def test_no_parser_guesses_options(top: Callable[[], argparse.ArgumentParser]) -> None:
    """An option is what is spelled out, in each verb, each verb's verb and each line of a script."""
    found = list(parsers_below(top()))
    assert len(found) > 10
    assert [parser.prog for parser in found if parser.allow_abbrev] == []


@pytest.mark.parametrize(
    "argv",
    [
        ["gateway", "--worker", "2"],
        ["gateway", "--work=2"],
        ["stop", "--rel", "--all"],
        ["stop", "--gr", "3"],
        ["agent", "--name", "here"],
        ["headset", "127.0.0.1", "pub", "/t", "std_msgs/String", "{}", "--cou", "1"],
    ],
    ids=" ".join,
)
def test_the_beginning_of_an_option_is_no_option(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """What argparse would complete is refused."""
    with pytest.raises(SystemExit) as ended:
        main(argv)
    assert ended.value.code == 2
    assert "unrecognized arguments" in capsys.readouterr().err


def test_what_is_internal_is_not_offered(capsys: pytest.CaptureFixture[str]) -> None:
    """Options between our own programs are in no help and meant by nobody."""
    with pytest.raises(SystemExit):
        main(["gateway", "--be-worker-on-prt", "7000"])
    assert "did you mean" not in capsys.readouterr().err


def test_without_a_verb_there_is_help(capsys: pytest.CaptureFixture[str]) -> None:
    """`macs` alone shows what there is, on stderr, and is wrong usage."""
    with pytest.raises(SystemExit) as ended:
        main([])
    assert ended.value.code == 2
    shown = capsys.readouterr().err
    assert all(f"    {verb:12}" in shown for verb in VERBS)
    assert shown.endswith("macs: no verb was given\n")


# -- settings --------------------------------------------------------------------------------------------------------


def test_options_are_spelled_as_zenohs_tools_spell_them() -> None:
    """-c -m -e -l --cfg reach the mesh settings."""
    args = parsed(
        "gateway",
        "-c",
        "z.json5",
        "-m",
        "peer",
        "-e",
        "tcp/a:1",
        "-e",
        "tcp/b:2",
        "-l",
        "tcp/0.0.0.0:0",
        "--cfg",
        "x:1",
    )
    assert options.settings(args).mesh == MeshSettings(
        config_file="z.json5",
        mode="peer",
        connect=["tcp/a:1", "tcp/b:2"],
        listen=["tcp/0.0.0.0:0"],
        overrides=["x:1"],
    )


def test_no_options_are_all_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without options, files and environment the defaults hold."""
    for name in ("MACS_CONNECT", "ZENOH_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    assert options.settings(parsed("gateway")) == Settings()


def test_the_environment_names_a_zenoh_file_unless_an_option_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """ZENOH_CONFIG is the default of -c."""
    monkeypatch.setenv("ZENOH_CONFIG", "env.json5")
    assert options.settings(parsed("ls")).mesh.config_file == "env.json5"
    assert options.settings(parsed("ls", "-c", "option.json5")).mesh.config_file == "option.json5"


@pytest.fixture
def unnamed(monkeypatch: pytest.MonkeyPatch) -> None:
    """No program's environment but ours."""
    for name in ("MACS_CONNECT", "ZENOH_CONFIG"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize("verb", ["ls", "stop", "doctor", "gateway", "agent", "awareness"])
def test_the_environment_names_routers_unless_somebody_does(
    verb: str, unnamed: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """MACS_CONNECT stands for -e; an option, a settings file and a Zenoh configuration win over it."""
    monkeypatch.setenv("MACS_CONNECT", "tcp/a:1, tcp/b:2")
    assert options.settings(parsed(verb)).mesh.connect == ["tcp/a:1", "tcp/b:2"]
    assert options.settings(parsed(verb, "-e", "tcp/c:3")).mesh.connect == ["tcp/c:3"]
    assert options.settings(parsed(verb, "-c", "z.json5")).mesh.connect == []
    file = tmp_path / "macs.toml"
    file.write_text('[mesh]\nconnect = ["tcp/file:1"]\n')
    assert options.settings(parsed(verb, "--settings", str(file))).mesh.connect == ["tcp/file:1"]
    monkeypatch.setenv("MACS_CONNECT", "nonsense")
    with pytest.raises(UsageError, match="MACS_CONNECT: 'nonsense' is not a Zenoh endpoint"):
        options.settings(parsed(verb))


def test_the_environment_links_no_routers(unnamed: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A router does not dial itself because programs beside it are told of it; `macs up` starts one all the same."""
    monkeypatch.setenv("MACS_CONNECT", "tcp/127.0.0.1:7447")
    assert options.settings(parsed("router")).mesh.connect == []
    assert plan().router_child() is not None


@pytest.mark.parametrize(
    ("words", "caller"),
    [
        ([], "operator/5"),
        (["--as", "operator"], "operator/0"),
        (["--as", "operator/7"], "operator/7"),
        (["--as", "unity/300"], "unity/300"),
        (["--as", "ros/7"], "ros/7"),
        (["--as", "gateway/1"], "unity/511"),
        (["--as", "observer"], "operator/0"),
    ],
)
@pytest.mark.parametrize("verb", ["ls", "stop", "doctor"])
def test_as_means_the_same_to_every_verb(verb: str, words: list[str], caller: str) -> None:
    """Whoever is named, who calls a robot is an agent; without it the settings say who."""
    args = parsed(verb, *words)
    assert str(robots.chosen_caller(args, OperatorSettings(id=5))) == caller


@pytest.mark.parametrize(
    "who", ["gateway", "gateway/256", "ros", "ros/65536", "robot/7", "observer/1", "operator/-1", ""]
)
@pytest.mark.parametrize("verb", ["ls", "stop", "doctor"])
def test_as_names_somebody(verb: str, who: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Who is nobody is wrong usage, told by the verb."""
    with pytest.raises(SystemExit) as ended:
        main([verb, "--as", who])
    assert ended.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"macs {verb}: error: argument --as: ")


def test_an_option_wins_over_the_settings_file(tmp_path: Path) -> None:
    """What is given on the command line replaces the file's value; --cfg is added to the file's overrides."""
    file = tmp_path / "macs.toml"
    file.write_text('[mesh]\nconnect = ["tcp/file:1"]\nlease_ms = 3000\noverrides = ["a:1"]\n')
    settings = options.settings(parsed("ls", "--settings", str(file), "-e", "tcp/option:1", "--cfg", "b:2"))
    assert settings.mesh == MeshSettings(connect=["tcp/option:1"], lease_ms=3000, overrides=["a:1", "b:2"])


def test_ros_arguments_go_to_the_end_of_the_line() -> None:
    """Everything after --ros-args is ROS's, also what looks like an option of ours."""
    assert parsed("agent", "--id", "7", "--ros-args", "-r", "__ns:=/r7", "-e", "x").ros_args == [
        "-r",
        "__ns:=/r7",
        "-e",
        "x",
    ]


# -- keys ------------------------------------------------------------------------------------------------------------


def test_keys_prints_every_key_space(capsys: pytest.CaptureFixture[str]) -> None:
    """The table has each key space with its key."""
    assert main(["keys"]) == 0
    shown = capsys.readouterr().out
    for name, key in KEYS.items():
        assert name in shown
        assert key.template in shown


def test_keys_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    """--json is the same table for programs."""
    assert main(["keys", "--json"]) == 0
    assert {row["space"]: row["key"] for row in json.loads(capsys.readouterr().out)} == {
        name: key.template for name, key in KEYS.items()
    }


def test_keys_explains_a_key(capsys: pytest.CaptureFixture[str]) -> None:
    """A concrete key is taken apart."""
    assert main(["keys", "macs/to/ros/0/7/unity/9"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("unicast: ")
    assert "id        7" in shown
    assert "from_type unity (type 2)" in shown


def test_keys_does_not_know_every_key(capsys: pytest.CaptureFixture[str]) -> None:
    """A key of nobody's space, or with a wildcard, is exit code 1."""
    assert main(["keys", "macs/to/ros/**"]) == 1
    assert "no concrete key" in capsys.readouterr().err


# -- what help says is printed ---------------------------------------------------------------------------------------


def promised(verb: str) -> list[str]:
    """The lines below "what it prints" in the help of a verb."""
    text = (VERBS[verb].__doc__ or "").partition("what it prints:\n")[2]
    return [line.removeprefix("  ") for line in text.splitlines()]


def test_keys_prints_what_its_help_shows(capsys: pytest.CaptureFixture[str]) -> None:
    """The example is how the table begins."""
    assert main(["keys"]) == 0
    assert capsys.readouterr().out.splitlines()[: len(promised("keys"))] == promised("keys")


def test_ls_prints_what_its_help_shows() -> None:
    """The example is what `ls` makes of such a mesh."""
    robot, headset = AgentInfo(1, 7, 3, "3c41ba1c00"), AgentInfo(2, 256, 0, "9f2d07e100")
    control = {"holder": "unity/256"}
    node = {"role": "publisher", "name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "control": control}
    said = {"ros_node": "/r", "stopped": True, "stop": {"by": "operator/5"}, "nodes": [node]}
    told = {7: ls.RobotReport(status=msgspec.convert(said, RobotStatus))}
    pongs = {headset.zid: Pong(time_s=0.0, address="10.0.0.5:7000", macs="0.1.0", zenoh="1.10.2")}
    routers = [robots.Router("d8c1f2aa", "v1.10.2-release built", ["tcp/10.0.0.1:7447"])]
    agents = [robot, headset]
    blocks = ls._text(agents, [Named("drone0", 1, 7, robot.zid)], told, [], verbose=False)
    blocks += ls._shown_infrastructure(ls._infrastructure(agents, pongs, routers))
    assert terminal.drawn(blocks, io.StringIO()).splitlines() == promised("ls")


def test_doctor_prints_what_its_help_shows() -> None:
    """The example is what it says of one router that answers and one that does not."""
    version, throughput = "Zenoh 1.10.2", ", about 330 Mbit/s"
    findings = [
        found("router_ok", "tcp/10.0.0.1:7447", version=version, round_trip="0.9 ms", throughput=throughput),
        found("refused", "tcp/10.0.0.2:7447", severity=Severity.WARNING),
    ]
    blocks = list(doctor.shown(findings, Facts(at_s=0.0, own=Own(), probe_bytes=2_800_000)))
    assert terminal.drawn(blocks, io.StringIO()).splitlines() == promised("doctor")


def test_init_prints_what_its_help_shows(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The files that it has written, where nobody said where to."""
    monkeypatch.chdir(tmp_path)
    assert main(["init", "robot"]) == 0
    assert capsys.readouterr().out.splitlines() == promised("init")


def test_stop_prints_what_its_help_shows() -> None:
    """One line for a robot that stopped and one for a robot that did not."""
    outcomes = [stop.Outcome(7, True, True, "operator/0"), stop.Outcome(8, False, problem="no answer within 5 s")]
    assert [stop._line(outcome, release=False) for outcome in outcomes] == promised("stop")


# -- up --------------------------------------------------------------------------------------------------------------


def plan(*argv: str) -> up.Plan:
    args = parsed("up", "--port", "0", "--router-port", "0", *argv)
    return up.make_plan(args, options.settings_file(args))


def test_up_listens_on_this_machine_only() -> None:
    """Unless asked for, nothing that `macs up` starts can be reached from the network."""
    here = plan()
    router = here.router_child()
    assert router is not None
    assert router.argv[-2:] == ["-l", f"tcp/127.0.0.1:{here.router_port}"]
    assert here.gateway.host == "127.0.0.1"


def test_up_opens_gateway_and_router_together() -> None:
    """--host 0.0.0.0 lets headsets and other robots in."""
    router = plan("--host", "0.0.0.0").router_child()
    assert router is not None
    assert router.argv[-1].startswith("tcp/[::]:")


def test_up_joins_a_router_that_is_there() -> None:
    """With -e no router is started, and gateway and robot use that one."""
    joined = plan("-e", "tcp/10.0.0.1:7447")
    assert joined.router_child() is None
    for child in [joined.gateway_child(), *joined.robot_children()]:
        assert child.argv[child.argv.index("-e") + 1] == "tcp/10.0.0.1:7447"


def test_up_has_robot_1_unless_told() -> None:
    """The robot's id is fixed, 1 by default."""
    assert plan().robot.id == 1
    assert plan("--id", "7", "--group", "3").robot.id == 7


def test_up_tells_that_a_port_is_taken() -> None:
    """A port in use is found before anything is started, with what to do."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        with pytest.raises(up.PortTaken, match="--port"):
            plan("--port", port)
        with pytest.raises(up.PortTaken, match=f"-e tcp/127.0.0.1:{port}"):
            plan("--router-port", port)


def test_up_refuses_an_id_out_of_range() -> None:
    """The ranges of the settings hold for options."""
    with pytest.raises(ConfigError, match=r"robot\.id"):
        plan("--id", "70000")


def test_what_next_names_the_addresses_in_use() -> None:
    """The closing hints work as they are printed."""
    here = plan("--demo")
    hints = up.what_next(here)
    assert f"macs ls -e tcp/127.0.0.1:{here.router_port} --namespace demo" in hints
    assert f"macs headset 127.0.0.1:{here.gateway.port} sub /pose" in hints
    web = f"127.0.0.1:{here.gateway.web_port}"
    assert f"in a browser at http://{web} (programs: ws://{web}/macs)." in hints
    assert here.apart is not None
    assert f"ROS_DOMAIN_ID={here.apart.domain} " in hints
    here.apart.close()


# -- supervisor ------------------------------------------------------------------------------------------------------


def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> supervisor.Child:
    """A child that runs some code instead of a verb."""
    (tmp_path / "child_program.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return supervisor.Child("child", ["child_program"])


async def test_a_child_that_cannot_start_is_not_started_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that ends at once, before it was ready, ends `macs up` with it."""
    child = script(tmp_path, monkeypatch, "raise SystemExit(1)")
    with pytest.raises(supervisor.ChildFailed):
        await child.run()
    assert child.starts == 1


async def test_a_child_that_dies_is_started_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that was ready once is kept alive; one that finds its configuration wrong is not."""
    monkeypatch.setattr(supervisor, "FIRST_PAUSE_S", 0.01)
    code = f"""
import pathlib, sys
marks = pathlib.Path({str(tmp_path)!r}, "starts")
marks.write_text(marks.read_text() + "x" if marks.exists() else "x")
print("ready: here")
sys.exit(2 if len(marks.read_text()) == 3 else 1)
"""
    child = script(tmp_path, monkeypatch, code)
    with pytest.raises(supervisor.ChildFailed) as failed:
        await child.run()
    assert failed.value.code == 2
    assert child.starts == 3
    assert child.ready.is_set()


@pytest.mark.parametrize(
    ("argv", "missing", "extra"),
    [
        (["headset", "127.0.0.1", "sub", "/t", "std_msgs/String"], "rosbags", "headset"),
        (["security", "generate", "policy.yaml", "--into", "somewhere"], "yaml", "security"),
        (["security", "generate", "policy.yaml", "--into", "somewhere"], "cryptography", "security"),
    ],
)
def test_a_missing_extra_is_exit_code_1(argv: list[str], missing: str, extra: str, tmp_path: Path) -> None:
    """What is not installed is told once, with what to install, by whichever verb needs it."""
    (tmp_path / "policy.yaml").write_text("{}")
    code = (
        "import sys; from importlib.abc import MetaPathFinder\n"
        "class Hidden(MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        f"        if name.partition('.')[0] == {missing!r}: raise ImportError(name)\n"
        "sys.meta_path.insert(0, Hidden())\n"
        f"from bridge.cli import main; sys.exit(main({argv!r}))"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 1, ended.stderr
    (line,) = ended.stderr.splitlines()
    assert line.startswith(f"macs {argv[0]}: ")
    assert line.count("macs ") == 1
    assert f"pip install 'macs-zenoh[{extra}]'" in line


def test_help_of_awareness_names_the_node_that_there_is() -> None:
    """What its example configures is what the program makes."""
    node = re.search(r"^NODE_NAME = \"(\w+)\"", Path(awareness_node()).read_text(encoding="utf-8"), re.MULTILINE)
    assert node is not None
    assert f"ros2 lifecycle set /{node[1]} configure" in (VERBS["awareness"].__doc__ or "")


def awareness_node() -> str:
    return str(Path(__file__).parents[2] / "bridge" / "awareness" / "node.py")


async def test_a_gateway_lets_threads_take_turns_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its loop waits for Zenoh's threads after each piece that TLS encrypts: before it opens a session that is set."""
    from bridge import memory
    from bridge.cli import gateway
    from macs_zenoh.mesh import Mesh

    class Opened(Exception):
        pass

    async def opening(*args: object, **how: object) -> Mesh:
        raise Opened

    called: list[float] = []
    monkeypatch.setattr(sys, "setswitchinterval", called.append)
    for name in ("give_back", "collect_seldom"):
        monkeypatch.setattr(memory, name, lambda: None)
    monkeypatch.setattr(Mesh, "open", opening)
    with pytest.raises(Opened):
        await gateway._be_gateway(Settings(), [])
    assert called == [0.001]
