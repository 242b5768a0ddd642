"""Build a ROS interface package (.msg, .srv, .action) for a ROS that was installed with pip.

PATH is an ordinary interface package: package.xml, and definitions in msg/, srv/ and action/. The
result is a wheel for this Python. It needs g++ and Python's headers, and nothing from the network.
With a ROS installation, build the same folder with colcon instead.

examples:
  macs interfaces build as2_ca_msgs --install                 one that comes with macs, by its name
  macs interfaces build my_msgs --into dist && pip install --no-deps dist/my_msgs-*.whl
  macs interfaces build my_msgs --json | jq .hashes

what it prints:
  as2_ca_msgs/msg/InterAgentMessage  RIHS01_7d534e45…
  dist/as2_ca_msgs-0.1.0-cp312-cp312-linux_x86_64.whl"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from bridge.cli import output, terminal
from bridge.cli.terminal import Columns
from macs_zenoh.errors import Unreachable

SUMMARY = "build ROS interface packages where ROS comes from pip"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="what", metavar="VERB", required=True, title="verbs")
    _add_build(verbs.add_parser("build", help="make a wheel of a package", description="Make a wheel of a package."))


def _add_build(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", type=Path, help="the package's folder, or the name of a shipped one")
    parser.add_argument("--into", metavar="DIR", type=Path, default=Path("dist"), help="for the wheel (default: dist)")
    parser.add_argument("--install", action="store_true", help="install the wheel into this Python as well")
    parser.add_argument("--json", action="store_true", help="for programs: wheel and type hashes")


def run(args: argparse.Namespace) -> int:
    from bridge import shipped
    from bridge.interfaces import build

    ours = str(args.path) in shipped.interface_packages() and not args.path.exists()
    built = build(shipped.interface_package(str(args.path)) if ours else args.path, args.into)
    if args.install:
        _install(built.wheel)
    if args.json:
        output.say(json.dumps({"wheel": str(built.wheel), "hashes": built.hashes}))
        return 0
    terminal.show(Columns(sorted(built.hashes.items())), str(built.wheel))
    return 0


def _install(wheel: Path) -> None:
    """Put it into this environment, over an earlier build; dependencies are there, or it could not have been built."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index"]
    result = subprocess.run(  # noqa: S603 - pip of this Python
        [*command, "--no-deps", "--force-reinstall", str(wheel)], capture_output=True, text=True, check=False
    )
    if result.returncode:
        raise Unreachable("this Python's packages", (result.stderr.strip().splitlines() or ["pip failed"])[-1])
