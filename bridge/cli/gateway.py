"""Run a gateway: existing headsets (and robots) connect here over TCP and are agents on the mesh.

Headsets need nothing but this address. Without a router yet, the gateway waits for one.

examples:
  macs gateway                                             headsets on this machine, router on this machine
  macs gateway --host 0.0.0.0                              headsets from the network
  macs gateway --port 7001 -e tcp/10.0.0.1:7447 -e tcp/10.0.0.2:7447   two routers, for fail-over"""

from __future__ import annotations

import argparse
import asyncio

from bridge.cli import options, running
from macs_zenoh.config import Settings, changed

SUMMARY = "where headsets connect over TCP"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--host", help="address to listen on (default: 127.0.0.1; 0.0.0.0 for the network)")
    parser.add_argument("--port", type=int, help="TCP port (default: 7000; 0 for any free one)")
    parser.add_argument(
        "--allow", metavar="NETWORK", action="append", help="who may connect, as 192.168.1.0/24; repeat for more"
    )
    parser.add_argument("--block", type=int, help="block of 256 agent ids to give out (default: the first free one)")
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    listen_on = changed(settings.gateway, host=args.host, port=args.port, allow=args.allow, block=args.block)
    return running.until_stopped(lambda: _serve(changed(settings, gateway=listen_on)))


async def _serve(settings: Settings) -> int:
    from bridge.gateway import Gateway
    from macs_zenoh.mesh import Mesh

    async with await Mesh.open(settings.mesh) as mesh:
        gateway = Gateway(mesh, settings.gateway)
        try:
            await gateway.start()
            running.say_ready(f"gateway on {settings.gateway.host}:{gateway.port}")
            await asyncio.Event().wait()
        finally:
            await gateway.close()
    return 0
