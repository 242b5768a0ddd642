"""List the agents that are online: robots and headsets, whichever gateway they are behind.

A headset's session is its gateway's, so headsets with one session share a gateway.
Exit code 1 when no router answers.

examples:
  macs ls
  macs ls -e tcp/192.168.1.10:7447
  macs ls --json | jq '.[] | select(.type == "ros").id'"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys

from bridge.cli import options, running
from macs_zenoh.config import MeshSettings
from macs_zenoh.directory import AgentInfo, Directory
from macs_zenoh.errors import Unreachable
from macs_zenoh.keyexpr import PRESENCE

SUMMARY = "who is online"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="for programs: a list of {type, id, group, zid}")
    parser.add_argument(
        "--timeout", type=float, default=3.0, metavar="S", help="how long to wait for a router (default: 3)"
    )
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args).mesh

    async def show() -> int:
        agents = await online(settings, timeout_s=args.timeout)
        sys.stdout.write((_json(agents) if args.json else _table(agents)) + "\n")
        return 0

    return running.until_stopped(show)


async def online(settings: MeshSettings, *, timeout_s: float) -> list[AgentInfo]:
    """Everybody on the mesh, seen by a session that joins nothing. Raises Unreachable without a router."""
    from macs_zenoh.mesh import Mesh

    try:
        mesh = await asyncio.wait_for(Mesh.open(settings, on_waiting=lambda target: None), timeout_s)
    except asyncio.TimeoutError:
        target = ", ".join(settings.routers) or "a router"
        raise Unreachable(target, f"no Zenoh router answered within {timeout_s:g} s") from None
    async with mesh:
        directory = Directory()
        for key in await mesh.tokens(PRESENCE.every(), timeout_s=timeout_s):
            directory.token(key, True, 0.0)
        return list(directory)


def _json(agents: list[AgentInfo]) -> str:
    return json.dumps([{"type": a.type_name, "id": a.id, "group": a.group, "zid": a.zid} for a in agents])


def _table(agents: list[AgentInfo]) -> str:
    if not agents:
        return "nobody is online"
    rows = [("TYPE", "ID", "GROUP", "SESSION")]
    rows += [(a.type_name, str(a.id), str(a.group) if a.group else "-", a.zid) for a in agents]
    return "\n".join(f"{kind:<8}{number:>6}{group:>7}  {zid}" for kind, number, group, zid in rows)
