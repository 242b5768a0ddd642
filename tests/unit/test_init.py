"""`macs init`: what was said on the command line stands in what it writes, and what can never work is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridge.cli import main
from bridge.settings import load


def written(tmp_path: Path, *argv: str) -> Path:
    """The folder after ``macs init ...``."""
    assert main(["init", *argv, "--into", str(tmp_path / "new")]) == 0
    return tmp_path / "new"


def test_a_robot(tmp_path: Path) -> None:
    """Id, group and routers are the given ones; the rest is as shipped."""
    folder = written(
        tmp_path, "robot", "--id", "7", "--group", "3", "-e", "tcp/10.0.0.1:7447", "-e", "tcp/10.0.0.2:7447"
    )
    settings = load(folder / "robot.toml")
    assert (settings.robot.id, settings.robot.group) == (7, 3)
    assert settings.mesh.connect == ["tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447"]
    assert settings.robot.rules[0].deadman_s == 0.5
    assert "config/" not in (folder / "robot.toml").read_text(), "macs.toml is beside it"


def test_a_router(tmp_path: Path) -> None:
    """It listens on this machine unless told, and where it was told then."""
    assert 'endpoints: ["tcp/127.0.0.1:7447"]' in (written(tmp_path / "a", "router") / "router.json5").read_text()
    told = written(tmp_path / "b", "router", "-l", "tcp/[::]:7000") / "router.json5"
    assert 'endpoints: ["tcp/[::]:7000"]' in told.read_text()


@pytest.mark.parametrize(
    "argv",
    [
        ["robot", "--id", "0"],
        ["robot", "-e", "10.0.0.1:7447"],
        ["router", "-l", "nowhere"],
        ["robot", "--group", "256"],
    ],
)
def test_what_can_never_work(tmp_path: Path, argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """It is said in one line, with exit code 2, and nothing is written."""
    assert main(["init", *argv, "--into", str(tmp_path / "new")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file that is there stays, and none is written beside it."""
    (tmp_path / "robot.toml").write_text("mine")
    assert main(["init", "robot", "--into", str(tmp_path)]) == 2
    assert "robot.toml: already there" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["robot.toml"]
