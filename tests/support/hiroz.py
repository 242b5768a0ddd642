"""ROS nodes that nobody here wrote: the examples of the Rust crate hiroz, ROS 2 on Zenoh without ROS.

``make hiroz`` builds them with cargo, once (some minutes), in a folder of the user's own. A test that wants them where
they are not is skipped.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from tests.support.processes import Process

VERSION = "0.2.1"
PROGRAMS = (
    "talker",
    "listener",
    "add_two_ints_server",
    "add_two_ints_client",
    "fibonacci_action_server",
    "fibonacci_action_client",
)
PROJECT = f"""
[package]
name = "examples"
version = "0.0.0"
edition = "2024"

[features]
default = ["jazzy"]
jazzy = []
kilted = []
lyrical = []

[dependencies]
hiroz = "={VERSION}"
hiroz-msgs = "={VERSION}"
tokio = {{ version = "1", features = ["full"] }}
clap = {{ version = "4", features = ["derive"] }}
zenoh = {{ version = "1", default-features = false }}

[profile.dev]
debug = 0
incremental = false
strip = true
"""


def folder() -> Path:
    """Where they are, or would be."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "macs-zenoh" / f"hiroz-{VERSION}"


def program(name: str) -> Path:
    """One of `PROGRAMS`. Skips the test where it has not been built."""
    found = folder() / name
    if not found.exists():
        pytest.skip(f"the examples of hiroz {VERSION} are not here: make hiroz, which needs cargo")
    return found


class Example(Process):
    """One of them, in a process of its own: there when it has said its first line, or a line with ``ready`` in it."""

    def __init__(self, name: str, *arguments: str, ready: str = "", domain: int = 0) -> None:
        super().__init__(str(program(name)), *arguments, env={"ROS_DOMAIN_ID": str(domain)})
        self.said: list[str] = []
        self._ready_by = ready

    def _heard(self, line: str, *, is_log: bool) -> bool:
        self.said.append(line)
        return self._ready_by in line

    def says(self, text: str) -> bool:
        """Whether a line has this in it."""
        return any(text in line for line in self.said)


def build() -> int:
    """Build what is not there; 0 also where there is no cargo, which is said."""
    target = folder()
    if all((target / name).exists() for name in PROGRAMS):
        return 0
    if shutil.which("cargo") is None:
        print(f"hiroz {VERSION} is not here and there is no cargo to build it (https://rustup.rs); nothing done")
        return 0
    print(f"building the examples of hiroz {VERSION} with cargo; this takes some minutes, once", flush=True)
    project = target / "project"
    (project / "src" / "bin").mkdir(parents=True, exist_ok=True)
    (project / "src" / "lib.rs").touch()
    (project / "Cargo.toml").write_text(PROJECT, encoding="utf-8")
    _cargo(project, "fetch", "--quiet")
    home = Path(os.environ.get("CARGO_HOME") or Path.home() / ".cargo")
    examples = next(home.glob(f"registry/src/*/hiroz-{VERSION}/examples/demo_nodes"))
    _each(PROGRAMS, lambda name: shutil.copy(examples / f"{name}.rs", project / "src" / "bin"))
    _cargo(project, "build", "--quiet", "--bins")
    _each(PROGRAMS, lambda name: shutil.copy(project / "target" / "debug" / name, target))
    shutil.rmtree(project)
    return 0


def _cargo(project: Path, *words: str) -> None:
    subprocess.run(["cargo", *words], cwd=project, check=True)


def _each(names: Iterable[str], do: Callable[[str], object]) -> None:
    for name in names:
        do(name)


if __name__ == "__main__":
    sys.exit(build())
