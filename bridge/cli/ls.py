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
from typing import Any

from bridge.cli import options, running
from macs_zenoh.config import MeshSettings
from macs_zenoh.directory import AgentInfo, Directory
from macs_zenoh.errors import Unreachable
from macs_zenoh.keyexpr import NAME, PRESENCE
from macs_zenoh.named import Named, Names

SUMMARY = "who is online"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="for programs: a list of {type, id, group, zid, name}")
    parser.add_argument(
        "--timeout", type=float, default=3.0, metavar="S", help="how long to wait for a router (default: 3)"
    )
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args).mesh

    async def show() -> int:
        agents, names = await online(settings, timeout_s=args.timeout)
        sys.stdout.write((_json(agents, names) if args.json else _table(agents, names)) + "\n")
        return 0

    return running.until_stopped(show)


async def online(settings: MeshSettings, *, timeout_s: float) -> tuple[list[AgentInfo], list[Named]]:
    """Everybody on the mesh, and the names by which some are reached, seen by a session that joins nothing.

    Raises Unreachable without a router.
    """
    from macs_zenoh.mesh import Mesh

    try:
        mesh = await asyncio.wait_for(Mesh.open(settings, on_waiting=lambda target: None), timeout_s)
    except asyncio.TimeoutError:
        target = ", ".join(settings.routers) or "a router"
        raise Unreachable(target, f"no Zenoh router answered within {timeout_s:g} s") from None
    async with mesh:
        directory, names = Directory(), Names()
        for key in await mesh.tokens(PRESENCE.every(), timeout_s=timeout_s):
            directory.token(key, True, 0.0)
        for key in await mesh.tokens(NAME.every(), timeout_s=timeout_s):
            names.token(key, True)
        return list(directory), list(names)


def _rows(agents: list[AgentInfo], names: list[Named]) -> list[dict[str, Any]]:
    """One row per agent with its name if it has one; a name whose agent is not online has a row of its own."""
    online = {agent.key for agent in agents}
    name_of = {(named.type, named.id): named.name for named in names}
    rows = [
        {"type": a.type_name, "id": a.id, "group": a.group, "zid": a.zid, "name": name_of.get(a.key, "")}
        for a in agents
    ]
    return rows + [
        {"type": named.type_name, "id": named.id, "group": 0, "zid": named.zid, "name": named.name}
        for named in names
        if (named.type, named.id) not in online
    ]


def _json(agents: list[AgentInfo], names: list[Named]) -> str:
    return json.dumps(_rows(agents, names))


def _table(agents: list[AgentInfo], names: list[Named]) -> str:
    rows = _rows(agents, names)
    if not rows:
        return "nobody is online"
    width = max(len("SESSION"), *(len(row["zid"]) for row in rows))
    lines = [("TYPE", "ID", "GROUP", "SESSION", "NAME")]
    lines += [
        (row["type"], str(row["id"] or "-"), str(row["group"] or "-"), row["zid"], row["name"] or "-") for row in rows
    ]
    return "\n".join(
        f"{kind:<8}{number:>6}{group:>7}  {zid:<{width}}  {name}" for kind, number, group, zid, name in lines
    )
