"""Run a Zenoh router: where robots and gateways meet.

It is the same router as zenohd, without plugins. Any Zenoh program can connect to it, and a
zenohd that runs already does as well: then no `macs router` is needed.

examples:
  macs router
  macs router -l tcp/10.0.0.1:7447 -l tls/0.0.0.0:7448 -c tls.json5
  macs router -e tcp/other-site:7447             linked to another router"""

from __future__ import annotations

import argparse
import asyncio
import logging
from typing import TYPE_CHECKING

from bridge.cli import options, running
from macs_zenoh.config import EVERY_INTERFACE, MeshSettings, changed

if TYPE_CHECKING:
    from macs_zenoh.mesh import Mesh

log = logging.getLogger("macs.router")

SETTLE_S = 1.0
"""How long after a link is back all must be known that is behind it."""
ANSWER_S = 2.0
FORGOTTEN_S = 0.3
"""How long a router is away that starts again: other routers have to notice."""

SUMMARY = "a Zenoh router, where robots and gateways meet"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_mesh_options(parser, modes=())


def run(args: argparse.Namespace) -> int:
    mesh = changed(options.settings(args).mesh, mode="router")
    return running.until_stopped(lambda: _serve(mesh))


async def _serve(settings: MeshSettings) -> int:
    from macs_zenoh.mesh import Mesh

    known: set[str] = set()
    ready = False
    while True:
        async with await Mesh.open(settings) as mesh:
            if not ready:
                of_file = f"the endpoints of {settings.config_file}" if settings.config_file else EVERY_INTERFACE
                running.say_ready("router on " + (", ".join(settings.listen) or of_file))
                ready = True
            router = await _dead_link(mesh, known)
            log.warning("the link with router %s is back and carries nothing; starting again", router[:8])
        await asyncio.sleep(FORGOTTEN_S)


async def _dead_link(mesh: Mesh, known: set[str]) -> str:
    """Wait until a link with another router is back and carries nothing; the router's Zenoh id.

    Zenoh 1.10.2 works out its routes at most every 100 ms. A link that is lost and back in between is taken for one
    that was never lost: nothing that exists is declared on it again, for as long as it lasts.

    ``known`` are routers that have answered before: one that never does may not be allowed to.
    """
    back: asyncio.Queue[str] = asyncio.Queue()
    mesh.on_neighbour(back.put_nowait)
    for router in mesh.neighbours():  # those that were faster
        back.put_nowait(router)
    while True:
        router = await back.get()
        await asyncio.sleep(SETTLE_S)
        if await _answers(mesh, router):
            known.add(router)
        elif router in known and router in mesh.neighbours() and not await _answers(mesh, router):
            known.discard(router)  # should it be something else, once is enough
            return router


async def _answers(mesh: Mesh, router: str) -> bool:
    """Whether a router tells about itself."""
    return bool(await mesh.ask_all(f"@/{router}/router", timeout_s=ANSWER_S))
