"""Run a Zenoh router: where robots and gateways meet.

It is the same router as zenohd, without plugins. Any Zenoh program can connect to it, and a
zenohd that runs already does as well: then no `macs router` is needed.

Without -l it listens on every interface, as zenohd does, and without TLS and access rules anybody
who reaches it sees all and drives robots: for networks that you trust (docs/security.md).

examples:
  macs router
  macs router -l tcp/10.0.0.1:7447 -l tls/0.0.0.0:7448 -c tls.json5
  macs router -e tcp/other-site:7447             linked to another router

what it prints:
  ready: router on tcp/10.0.0.1:7447"""

from __future__ import annotations

import argparse
import logging

import msgspec

from bridge import memory
from bridge.cli import options, running
from macs_zenoh.config import EVERY_INTERFACE, MeshSettings
from macs_zenoh.sections import changed

log = logging.getLogger("macs.router")

SUMMARY = "a Zenoh router, where robots and gateways meet"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_metrics_option(parser)
    options.add_mesh_options(parser, modes=(), dials=False)


def run(args: argparse.Namespace) -> int:
    mesh = changed(options.settings(args).mesh, mode="router")
    # what passes has its namespace already; the router's own questions are about routers, which have none
    mesh = msgspec.structs.replace(mesh, namespace=None, overrides=[*mesh.overrides, "namespace:null"])
    return running.until_stopped(lambda: _serve(mesh, args.metrics))


async def _serve(settings: MeshSettings, metrics: str | None) -> int:
    from bridge.router import KEPT_IN, open_to_anybody, serve

    memory.give_back()

    def ready() -> None:
        for endpoint in open_to_anybody(settings):
            log.warning("%s is open: whoever reaches it sees all and drives robots; %s", endpoint, KEPT_IN)
        of_file = f"the endpoints of {settings.config_file}" if settings.config_file else EVERY_INTERFACE
        running.say_ready("router on " + (", ".join(settings.listen) or of_file))

    await serve(settings, on_ready=ready, metrics=metrics)
    return 0
