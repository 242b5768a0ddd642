"""The wheel, installed into an empty environment far from the checkout: every verb is there, and all it needs."""

from __future__ import annotations

import os
import re
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
from bridge.conformance.vectors import FILES
from tests.support.once import made_once
from tests.support.processes import ROOT

SETTINGS = ["macs.toml", "one-host/robot.toml", "systemd/macs-robot.service", "security/site.yaml"]
INTERFACES = ["as2_ca_msgs/package.xml", "as2_ca_msgs/msg/InterAgentMessage.msg"]


SOURCES = ["bridge", "macs_zenoh", "config", "interfaces", "pyproject.toml", "setup.py", "README.md", "LICENSE"]
VERSION = "1.2.3rc1"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with wheel and sdist of this checkout, built beside it: an old build/ must not help."""
    sources = tmp_path_factory.mktemp("sources")

    def make(folder: Path) -> None:
        copy_sources(sources)
        environment = {"SETUPTOOLS_SCM_PRETEND_VERSION_FOR_MACS_ZENOH": VERSION}
        build("sdist", sources, folder, **environment)
        (sdist,) = folder.glob("*.tar.gz")
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        build("wheel", folder / sdist.name.removesuffix(".tar.gz"), folder)  # the sdist knows its version

    return made_once(tmp_path_factory, "dist", make)


def copy_sources(into: Path) -> None:
    for name in SOURCES:
        copy = shutil.copy if (ROOT / name).is_file() else partial(shutil.copytree, symlinks=True)
        copy(ROOT / name, into / name)


def build(kind: str, sources: Path, into: Path, **environment: str) -> None:
    """Build an sdist or a wheel, with what is installed here."""
    code = f"from setuptools import build_meta; build_meta.build_{kind}({str(into)!r})"
    done = run(sys.executable, "-c", code, cwd=sources, **environment)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.fixture(scope="module")
def macs(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of an environment that has the wheel, and our dependencies without us."""

    def make(folder: Path) -> None:
        venv.create(folder, with_pip=False, symlinks=True)
        site = next((folder / "lib").glob("python*/site-packages"))
        (site / "dependencies.pth").write_text(f"{sysconfig.get_paths()['purelib']}\n")
        (wheel,) = built.glob("*.whl")
        install = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "install", "--quiet"]
        subprocess.run([*install, "--no-index", "--no-deps", "--ignore-installed", str(wheel)], check=True)

    return made_once(tmp_path_factory, "installed", make) / "bin" / "macs"


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
    wanted += [f"bridge/conformance/vectors/{name}.json" for name in FILES]
    wanted += ["bridge/py.typed", "macs_zenoh/py.typed"]
    page = ROOT / "bridge" / "page" / "static"  # with what npm brought, where it has been here
    wanted += [f"bridge/page/static/{path.relative_to(page)}" for path in page.rglob("*") if path.is_file()]
    wanted += ["bridge/page/npm/package-lock.json"]
    assert [name for name in wanted if name not in in_wheel] == []
    assert [name for name in wanted if name not in in_sdist] == []


def test_a_link_of_the_readme_leads_to_the_repository(built: Path) -> None:
    """PyPI shows the README alone, so none of its links is relative."""
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        headers, _, page = archive.read(metadata).decode().partition("\n\n")
    assert f"\nVersion: {VERSION}\n" in headers
    links = re.findall(r"\]\(([^)]+)\)", page)
    assert len(links) > 10
    assert [link for link in links if not link.startswith("https://")] == []


def test_the_version_is_the_tag(tmp_path: Path) -> None:
    """A checkout at a tag is that version; without a tag and without git it is a development version."""
    copy_sources(tmp_path)
    git = ["git", "-c", "user.name=test", "-c", "user.email=test@example.org", "-c", "commit.gpgsign=false"]
    ask = [sys.executable, "-m", "setuptools_scm"]
    assert run(*ask, cwd=tmp_path).stdout.strip() == "0.1.0.dev0"
    for words in (["init", "--quiet"], ["add", "."], ["commit", "--quiet", "-m", "one"]):
        assert run(*git, *words, cwd=tmp_path).returncode == 0
    assert re.fullmatch(r"0\.1\.0\.dev\d+\+g\w+", run(*ask, cwd=tmp_path).stdout.strip())
    assert run(*git, "tag", "v0.2.0", cwd=tmp_path).returncode == 0
    assert run(*ask, cwd=tmp_path).stdout.strip() == "0.2.0"


def test_the_program_says_its_version(macs: Path, tmp_path: Path) -> None:
    """On the command line and in Python it is the wheel's."""
    assert run(macs, "--version", cwd=tmp_path).stdout == f"macs-zenoh {VERSION}\n"
    says = "import macs_zenoh; print(macs_zenoh.__version__)"
    assert run(macs.parent / "python", "-c", says, cwd=tmp_path).stdout == f"{VERSION}\n"


def test_a_whole_round(macs: Path, tmp_path: Path) -> None:
    """Router, gateway, robot and headset out of the wheel alone: data comes, commands move the robot."""
    pytest.importorskip("rclpy")
    ros = os.pathsep.join(filter(None, [os.environ.get("AMENT_PREFIX_PATH"), sys.prefix]))  # of other tests as well
    done = run(
        macs, *["up", "--demo", "--once", "--port", "0", "--router-port", "0"], cwd=tmp_path, AMENT_PREFIX_PATH=ros
    )
    assert done.returncode == 0, done.stdout + done.stderr


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
    ros = os.pathsep.join(filter(None, [os.environ.get("AMENT_PREFIX_PATH"), sys.prefix]))  # of other tests as well
    done = run(macs, "interfaces", "build", "as2_ca_msgs", "--into", "dist", cwd=tmp_path, AMENT_PREFIX_PATH=ros)
    assert done.returncode == 0, done.stderr
    assert [path.name.split("-")[0] for path in (tmp_path / "dist").glob("*.whl")] == ["as2_ca_msgs"]
