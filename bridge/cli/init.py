"""Write settings and systemd units to start from, every line explained: for one robot, gateway or router, or a site.

Nothing is overwritten. What is not in a written file is a default; macs.toml, written beside it, has every setting.

examples:
  macs init robot --id 7 -e tcp/192.168.1.10:7447      robot.toml, macs-robot.service, robot.launch.py
  macs init gateway --into /etc/macs                   gateway.toml, macs-gateway.service
  macs init router                                     router.json5, macs-router.service, macs-zenohd.service
  macs init site --into hall-1                         two routers, a gateway, a robot, and a policy for certificates

what it prints:
  macs-robot/robot.toml
  macs-robot/macs-robot.service
  macs-robot/robot.launch.py
  macs-robot/macs.toml"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from bridge import shipped
from bridge.cli import output
from bridge.settings import RobotSettings
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import UsageError

SUMMARY = "write settings and units to start from"


class Kind(NamedTuple):
    """What one word after ``macs init`` writes."""

    files: Mapping[str, Sequence[str]]
    """Name in the folder → where it is in config/."""
    then: str
    """What to do next, with the folder as DIR."""


KINDS: dict[str, Kind] = {
    "robot": Kind(
        {
            "robot.toml": ("one-host", "robot.toml"),
            "macs-robot.service": ("systemd", "macs-robot.service"),
            "robot.launch.py": ("robot.launch.py",),
            "macs.toml": ("macs.toml",),
        },
        "Try it: macs agent --settings DIR/robot.toml",
    ),
    "gateway": Kind(
        {
            "gateway.toml": ("one-host", "gateway.toml"),
            "macs-gateway.service": ("systemd", "macs-gateway.service"),
            "macs.toml": ("macs.toml",),
        },
        "Try it: macs gateway --settings DIR/gateway.toml",
    ),
    "router": Kind(
        {
            "router.json5": ("one-host", "router.json5"),
            "macs-router.service": ("systemd", "macs-router.service"),
            "macs-zenohd.service": ("systemd", "macs-zenohd.service"),
        },
        "Try it: macs router -c DIR/router.json5",
    ),
    "site": Kind(
        {
            "router-a.json5": ("site", "router-a.json5"),
            "router-b.json5": ("site", "router-b.json5"),
            "gateway.toml": ("site", "gateway.toml"),
            "robot.toml": ("site", "robot.toml"),
            "macs.toml": ("macs.toml",),
            "policy.yaml": ("security", "site.yaml"),
            **{
                f"macs-{name}.service": ("systemd", f"macs-{name}.service")
                for name in ("router", "zenohd", "gateway", "robot")
            },
        },
        "Put your hosts into the files, your robots into policy.yaml; then: macs security generate DIR/policy.yaml",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", choices=list(KINDS), help="what runs on this machine")
    parser.add_argument("--into", metavar="DIR", type=Path, help="folder to write to (default: macs-KIND)")
    parser.add_argument(
        "-e", "--connect", metavar="ENDPOINT", action="append", help="router, as tcp/HOST:7447; repeat"
    )
    parser.add_argument("--id", type=int, metavar="N", help="robot: its number (default: 1)")
    parser.add_argument("--group", type=int, metavar="N", help="robot: its group")
    parser.add_argument(
        "-l", "--listen", metavar="ENDPOINT", action="append", help="router: where it listens (default: this machine)"
    )


def run(args: argparse.Namespace) -> int:
    kind = KINDS[args.kind]
    into = args.into or Path(f"macs-{args.kind}")
    written = {into / name: _changed(name, shipped.text(*source), args) for name, source in kind.files.items()}
    there = [str(path) for path in written if path.exists()]
    if there:
        raise UsageError(f"{', '.join(there)}: already there, and nothing is overwritten; name another folder: --into")
    into.mkdir(parents=True, exist_ok=True)
    for path, text in written.items():
        path.write_text(text, encoding="utf-8")
        output.say(f"{path}")
    output.note(f"\n{kind.then.replace('DIR', str(into))}")
    if (unit := f"macs-{args.kind}.service") in kind.files:
        output.note(f"To start it with the machine, what to copy where is said at the top of {into / unit}")
    return 0


def _changed(name: str, text: str, args: argparse.Namespace) -> str:
    """A shipped file with what was said on the command line in it. Raises ConfigError for what can never work."""
    text = text.replace("config/macs.toml", "macs.toml")  # it is written beside
    if name.endswith(".toml") and name != "macs.toml":
        MeshSettings(connect=args.connect or [])
        if args.connect:
            text = _line(r"connect = \[.*\]", f"connect = [{_quoted(args.connect)}]", text)
    if name == "robot.toml" and args.kind == "robot":
        text = _robot(text, args)
    if name == "router.json5" and args.listen:
        MeshSettings(mode="router", listen=args.listen)
        text = _line(r"listen: \{ endpoints: \[.*\] \}", f"listen: {{ endpoints: [{_quoted(args.listen)}] }}", text)
    return text


def _robot(text: str, args: argparse.Namespace) -> str:
    RobotSettings(id=args.id, group=args.group or 0)
    lines = [f"id = {1 if args.id is None else args.id}"] + ([f"group = {args.group}"] if args.group else [])
    return _line(r"id = \d+", "\n".join(lines), text)


def _line(pattern: str, line: str, text: str) -> str:
    """A shipped file with the one line that is like this exchanged."""
    changed, count = re.subn(rf"^(\s*){pattern}", lambda found: found[1] + line, text, flags=re.MULTILINE)
    assert count == 1, f"{count} lines are like {pattern}"
    return changed


def _quoted(endpoints: Sequence[str]) -> str:
    return ", ".join(f'"{endpoint}"' for endpoint in endpoints)
