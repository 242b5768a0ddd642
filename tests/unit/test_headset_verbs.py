"""The verbs of `macs headset` on the command line and in a script."""

from __future__ import annotations

import argparse

import pytest

from bridge.cli import headset
from bridge.headset.verbs import parse_target, script_parser
from macs_zenoh.errors import UsageError


def parse(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="macs headset")
    headset.add_arguments(parser)
    return parser.parse_args(words)


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ("127.0.0.1:7001", ("127.0.0.1", 7001)),
        ("localhost", ("localhost", 7000)),
        ("[::1]:7001", ("::1", 7001)),
        ("[::1]", ("::1", 7000)),
    ],
)
def test_targets(text: str, target: tuple[str, int]) -> None:
    """A target is a host with or without port, also in IPv6."""
    assert parse_target(text) == target


@pytest.mark.parametrize("text", ["", ":", ":7000", "host:", "host:x", "host:0", "host:65536"])
def test_wrong_targets(text: str) -> None:
    """What is no target is refused."""
    with pytest.raises(argparse.ArgumentTypeError, match="is no HOST:PORT"):
        parse_target(text)


def test_lists_of_robots_and_groups() -> None:
    """Robots and groups are lists with commas."""
    args = parse("h:1", "sub", "/a", "std_msgs/String", "--agents", "1,2", "--groups", "3", "--count", "5")
    assert (args.agents, args.groups, args.count, args.timeout) == ([1, 2], [3], 5, None)


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["h:1"],
        ["h:1", "fly"],
        ["h:1", "sub"],
        ["h:1", "sub", "/a", "b/C", "--agents", "0"],
        ["h:1", "sub", "/a", "b/C", "--agents", "65536"],
        ["h:1", "sub", "/a", "b/C", "--groups", "256"],
        ["h:1", "sub", "/a", "b/C", "--count", "0"],
        ["h:1", "sub", "/a", "b/C", "--timeout", "-1"],
        ["h:1", "pub", "/a", "b/C", "{}", "--rate", "0"],
        ["h:1", "send", "x", "--to", "moon"],
        ["h:1", "--group", "256", "online"],
    ],
)
def test_wrong_usage_ends_with_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """What cannot be meant ends with exit code 2 and a line about it."""
    with pytest.raises(SystemExit) as stopped:
        parse(*words)
    assert stopped.value.code == 2
    assert "error:" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["online", "sub", "pub", "call", "serve", "send", "listen", "run"])
def test_every_verb_teaches_with_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The help of each verb has an example that can be pasted."""
    with pytest.raises(SystemExit) as stopped:
        parse("h:1", verb, "--help")
    assert stopped.value.code == 0
    assert "macs headset 127.0.0.1:7000" in capsys.readouterr().out


@pytest.mark.parametrize("line", ["fly", "sub", "wait --count x", "online --help", "run -", "group 256", "sleep -1"])
def test_a_wrong_line_is_an_error(line: str) -> None:
    """A wrong line of a script raises instead of ending the process."""
    with pytest.raises(UsageError):
        script_parser().parse_args(line.split())


def test_help_in_a_script_writes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    """Asking for help in a script puts nothing between the JSON lines; the error carries it."""
    with pytest.raises(UsageError, match="usage:"):
        script_parser().parse_args(["online", "--help"])
    assert not capsys.readouterr().out


def test_each_verb_says_what_it_prints(capsys: pytest.CaptureFixture[str]) -> None:
    """Results are for programs, so help shows their form."""
    for verb in ("online", "sub", "pub", "call", "serve", "goal", "ask", "send", "listen"):
        with pytest.raises(SystemExit):
            parse("h:1", verb, "--help")
        assert "prints {" in capsys.readouterr().out.lower(), verb
