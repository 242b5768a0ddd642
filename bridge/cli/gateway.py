"""Run a gateway: existing headsets (and robots) connect here over TCP and become agents on the mesh.

Headsets need to know nothing but this address. While no router answers, the gateway waits for one.

examples:
  macs gateway                                             headsets on this machine, router on this machine
  macs gateway --host 0.0.0.0                              headsets from the network
  macs gateway --workers 4                                 four processes behind one port
  macs gateway --robots 1,2                                existing robot programs too, as robots 1 and 2
  macs gateway --host 0.0.0.0 --without-token nobody       headsets with a token (macs token create)
  macs gateway -m router -l tcp/127.0.0.1:7447             a router as well: for one machine, a hop less
  macs gateway --port 7001 -e tcp/10.0.0.1:7447 -e tcp/10.0.0.2:7447   two routers, for fail-over

what it prints:
  ready: gateway on 127.0.0.1:7000"""

from __future__ import annotations

import argparse
import asyncio
import logging
import resource
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from bridge import memory
from bridge.cli import options, running
from bridge.cli.supervisor import Child, stop_in_order
from bridge.listening import bound
from bridge.settings import GatewaySettings, Settings
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, UsageError
from macs_zenoh.protocol import endpoints
from macs_zenoh.protocol.addresses import is_local, joined
from macs_zenoh.sections import changed

if TYPE_CHECKING:
    from bridge.gateway import Gateway

log = logging.getLogger("macs.gateway")

SUMMARY = "where headsets connect over TCP"

WORKER_ON = "--be-worker-on-port"
"""Said to a worker by who starts it, before the words that were said to that one: a worker never starts others."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--host", help="address to listen on (default: 127.0.0.1; 0.0.0.0 for the network, :: with IPv6)"
    )
    parser.add_argument("--port", type=int, help="TCP port (default: 7000; 0 for any free one)")
    parser.add_argument("--tls-port", type=int, help="port for the same over TLS; needs --certificate and --key")
    parser.add_argument("--certificate", metavar="FILE", help="certificate (PEM) of the TLS port and of the web port")
    parser.add_argument("--key", metavar="FILE", help="its key (PEM)")
    parser.add_argument("--web-port", type=int, help="port for HTTP and WebSocket (default: none; 0 for any free one)")
    parser.add_argument("--web-host", help="address of the web port (default: as --host)")
    parser.add_argument("--tokens", metavar="FILE", help="file of tokens (default: as `macs token`)")
    parser.add_argument(
        "--without-token",
        metavar="WHO",
        help="who may come without a token to any port: nobody, everybody, or networks as 10.0.3.0/24,10.0.4.0/24"
        " (default: everybody to the plain port; to the others nobody, unless only this machine reaches them)",
    )
    parser.add_argument(
        "--allow", metavar="NETWORK", action="append", help="who may connect, as 192.168.1.0/24; repeat for more"
    )
    parser.add_argument(
        "--robots",
        metavar="IDS",
        type=_robots,
        help="ids that existing robot programs may have here, as 1,2 or any (default: none may come)",
    )
    parser.add_argument("--block", type=int, help="block of 256 agent ids to give out (default: the first free one)")
    parser.add_argument(
        "--workers", type=int, default=1, metavar="N", help="processes that share the port (default: 1)"
    )
    parser.add_argument(WORKER_ON, type=int, metavar="PORT", help=argparse.SUPPRESS)
    options.add_metrics_option(parser)
    options.add_mesh_options(parser, modes=("client", "peer", "router"))


def _robots(text: str) -> list[int] | str:
    return text if text == "any" else [int(each) for each in text.split(",")]


def _without_token(who: str | None) -> dict[str, str | list[str] | None]:
    """For all ports alike; a settings file can say it of each."""
    said = who if who in (None, "nobody", "everybody") else who.split(",")
    return {f"{port}_without_token": said for port in ("plain", "tls", "web")}


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    listen_on = changed(
        settings.gateway,
        host=args.host,
        port=args.port if args.be_worker_on_port is None else args.be_worker_on_port,
        tls_port=args.tls_port,
        web_port=args.web_port,
        web_host=args.web_host,
        certificate=args.certificate,
        key=args.key,
        tokens_file=args.tokens,
        **_without_token(args.without_token),
        allow=args.allow,
        block=args.block,
        robots=args.robots,
        reuse_port=None if args.be_worker_on_port is None else True,
    )
    if args.workers < 1:
        raise UsageError(f"--workers is {args.workers}, at least 1 is needed")
    if settings.mesh.mode == "router" and (args.workers > 1 or args.be_worker_on_port is not None):
        raise UsageError("a gateway that is the router is one process: leave out --workers, or run macs router")
    if args.workers > 1 and args.metrics is not None:
        raise UsageError("--workers share no port for figures: leave out --metrics, or run a gateway for each")
    if args.workers > 1 and args.be_worker_on_port is None:
        if 0 in (listen_on.tls_port, listen_on.web_port):
            raise UsageError("--workers share their ports: say which, and not 0, for --tls-port and --web-port")
        if listen_on.block is not None:
            raise UsageError("--block and --workers exclude each other: every worker leases a block of its own")
        return running.until_stopped(lambda: _supervise(args.workers, listen_on, args.words))
    return running.until_stopped(lambda: _serve(changed(settings, gateway=listen_on), args.metrics))


async def _supervise(workers: int, settings: GatewaySettings, words: Sequence[str]) -> int:
    """Run several gateways on one port, each with ids of its own; one that ends is started again. ``words``: what was
    said to this one, beginning with the verb."""
    with _reserved(settings) as number:
        port = str(number)
        argv = ["bridge", words[0], WORKER_ON, port, *words[1:]]
        children = [Child(f"gw{number}", argv) for number in range(1, workers + 1)]
        tasks = [asyncio.create_task(child.run()) for child in children]
        try:
            announcing = asyncio.create_task(_announce(children, f"gateway on {joined(settings.host, port)}"))
            await asyncio.gather(announcing, *tasks)
        finally:
            await stop_in_order([(children, 1.8)])
            for task in tasks:
                task.cancel()
    return 0


async def _announce(children: list[Child], what: str) -> None:
    for child in children:
        await child.ready.wait()
    running.say_ready(what)


@contextmanager
def _reserved(settings: GatewaySettings) -> Iterator[int]:
    """Hold a port that nobody has, without listening, so that all workers find the same one. Raises Unreachable."""
    for alone in bound(settings.host, settings.port):  # other gateways would share it with us, and headsets be torn
        alone.close()
    held = bound(settings.host, settings.port, shared=True)
    try:
        yield held[0].getsockname()[1]
    finally:
        for reserved in held:
            reserved.close()


def _raise_descriptor_limit() -> None:
    """A thousand headsets need more descriptors than most shells allow by default."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def _judge_router(settings: MeshSettings) -> None:
    """What a router says of its endpoints; and nobody holds a router's own program to the rules that it has. Raises
    ConfigError."""
    from bridge.router import KEPT_IN, open_to_anybody
    from macs_zenoh.mesh import configuration

    if endpoints.value_at(configuration(settings), "access_control/enabled"):
        raise ConfigError("mesh.mode", "access rules do not hold a gateway that is the router: run macs router")
    for endpoint in open_to_anybody(settings):
        log.warning("%s is open: whoever reaches it sees all and drives robots; %s", endpoint, KEPT_IN)


async def _serve(settings: Settings, metrics: str | None) -> int:
    """Be a gateway, and tell who watches it at ``metrics``."""
    now: list[Gateway] = []
    if metrics is None:
        return await _be_gateway(settings, now)
    from bridge.gateway.figures import watched_now
    from bridge.metrics.endpoint import watched_at

    async with watched_at(metrics, watched_now(lambda: now[-1] if now else None)):
        return await _be_gateway(settings, now)


async def _be_gateway(settings: Settings, now: list[Gateway]) -> int:
    from bridge.doctor.first import told_while_waiting
    from bridge.gateway import Gateway
    from macs_zenoh import managers
    from macs_zenoh.locked_out import locked_out
    from macs_zenoh.mesh import Mesh

    _raise_descriptor_limit()
    memory.give_back()
    running.switch_soon()
    memory.collect_seldom()
    if settings.mesh.mode == "router":
        _judge_router(settings.mesh)
    own = managers.load(settings.gateway.managers)
    waiting = told_while_waiting(settings.mesh)
    listening = settings.gateway
    while True:
        async with await Mesh.open(settings.mesh, traffic=settings.traffic, on_waiting=waiting) as mesh:
            gateway = Gateway(mesh, listening, own)
            now[:] = [gateway]
            try:
                await gateway.start()
                open_to_all = listening.plain_without_token == "everybody"  # noqa: S105 - no password
                if not listening.allow and not is_local(listening.host) and open_to_all:
                    log.warning(
                        "%s is open: whoever reaches it is a headset; --allow says which networks, and"
                        " --without-token nobody that a token is wanted (macs token)",
                        gateway.address,
                    )
                running.say_ready(f"gateway on {gateway.address}")
                await locked_out(mesh)
                listening = changed(  # headsets that come back look for it there
                    listening,
                    port=gateway.port,
                    tls_port=gateway.listeners.tls_port or None,
                    web_port=gateway.listeners.web_port or None,
                )
            finally:
                now.clear()
                await gateway.close()
