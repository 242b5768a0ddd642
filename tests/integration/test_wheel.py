"""The wheel, installed into an empty environment far from the checkout: every verb is there, and all it needs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from functools import partial
from pathlib import Path

import pytest

from bridge.cli import VERBS
from tests.programs import ROOT

SETTINGS = ["macs.toml", "one-host/robot.toml", "systemd/macs-robot.service", "security/site.yaml"]
INTERFACES = ["as2_ca_msgs/package.xml", "as2_ca_msgs/msg/InterAgentMessage.msg"]


SOURCES = ["bridge", "macs_zenoh", "config", "interfaces", "pyproject.toml", "README.md", "LICENSE"]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with wheel and sdist of this checkout, built beside it: an old build/ must not help."""
    sources, folder = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("dist")
    for name in SOURCES:
        copy = shutil.copy if (ROOT / name).is_file() else partial(shutil.copytree, symlinks=True)
        copy(ROOT / name, sources / name)
    build = f"from setuptools import build_meta as b; b.build_sdist({str(folder)!r}); b.build_wheel({str(folder)!r})"
    done = subprocess.run([sys.executable, "-c", build], cwd=sources, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return folder


@pytest.fixture(scope="module")
def macs(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of an environment that has the wheel, and our dependencies without us."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder, with_pip=False, symlinks=True)
    site = next((folder / "lib").glob("python*/site-packages"))
    (site / "dependencies.pth").write_text(f"{sysconfig.get_paths()['purelib']}\n")
    (wheel,) = built.glob("*.whl")
    install = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "install", "--quiet"]
    subprocess.run([*install, "--no-index", "--no-deps", "--ignore-installed", str(wheel)], check=True)
    return folder / "bin" / "macs"


def run(*argv: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, without this checkout on its path."""
    return subprocess.run(
        [str(word) for word in argv],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )


def test_wheel_and_sdist_have_the_shipped_files(built: Path) -> None:
    """Settings, units and interface packages are in both, and so are the types."""
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    in_wheel = set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    wanted = [f"bridge/data/config/{name}" for name in SETTINGS]
    wanted += [f"bridge/data/interfaces/{name}" for name in INTERFACES]
    wanted += ["bridge/py.typed", "macs_zenoh/py.typed"]
    assert [name for name in wanted if name not in in_wheel] == []
    assert [name for name in wanted if name not in in_sdist] == []


def test_the_installed_program_is_the_wheel(macs: Path, tmp_path: Path) -> None:
    """Nothing below comes from the checkout."""
    where = run(macs.parent / "python", "-c", "import bridge, macs_zenoh; print(bridge.__file__)", cwd=tmp_path)
    assert str(macs.parents[1]) in where.stdout


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_is_there(macs: Path, tmp_path: Path, verb: str) -> None:
    """Each verb of the installed command explains itself."""
    done = run(macs, verb, "--help", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"usage: macs {verb}")


@pytest.mark.parametrize("kind", ["robot", "gateway", "router", "site"])
def test_init_writes_what_programs_take(macs: Path, tmp_path: Path, kind: str) -> None:
    """``macs init`` needs no checkout, names what it wrote, and overwrites nothing."""
    done = run(macs, "init", kind, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    written = done.stdout.split()
    assert sorted(written) == sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    again = run(macs, "init", kind, cwd=tmp_path)
    assert again.returncode == 2
    assert "nothing is overwritten" in again.stderr


def test_a_shipped_interface_package_builds(macs: Path, tmp_path: Path) -> None:
    """What `macs awareness` needs can be had from the wheel alone."""
    pytest.importorskip("rclpy")
    ros = os.environ.get("AMENT_PREFIX_PATH") or sys.prefix
    done = run(macs, "interfaces", "build", "as2_ca_msgs", "--into", "dist", cwd=tmp_path, AMENT_PREFIX_PATH=ros)
    assert done.returncode == 0, done.stderr
    assert [path.name.split("-")[0] for path in (tmp_path / "dist").glob("*.whl")] == ["as2_ca_msgs"]
