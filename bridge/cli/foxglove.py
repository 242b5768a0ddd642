"""Show a mesh in Foxglove or Lichtblick, live: robots' topics as they are, who is there, stops, control, refusals.

Open ws://127.0.0.1:8765 there (Open connection, Foxglove WebSocket). A robot is asked for a topic while somebody looks
at it. The server has no passwords, and cannot tell one program of this machine from another, nor from a web page that
is open in a browser here: whoever reaches it sees the robots, and so it only shows them, and listens on this machine.

With --publish the publish and service panels work on /ROBOT/TOPIC. So does any web page that is open in a browser on
this machine: IT MAY MOVE EVERY ROBOT, as far as their rules, control, dead-man and emergency stop let a headset do so.

examples:
  macs foxglove -e tcp/192.168.1.10:7447
  macs foxglove --robot 7 --topics '/camera/**' --port 9000
  macs foxglove --robot 7 --publish
  macs foxglove --host 0.0.0.0 --tls-cert cert.pem --tls-key key.pem

what it prints:
  ready: foxglove on 127.0.0.1:8765"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from bridge.cli import options, running
from bridge.cli.amounts import pattern
from bridge.settings import Settings
from macs_zenoh.errors import ConfigError, Unreachable, UsageError
from macs_zenoh.protocol.addresses import is_local, joined

log = logging.getLogger("macs.foxglove")

SUMMARY = "show a mesh in Foxglove, live"

PORT = 8765


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", type=_port, default=PORT, help=f"where to listen, 0 for any (default: {PORT})")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument(
        "--publish",
        action="store_true",
        help="clients may publish and call services: any web page here may move robots",
    )
    parser.add_argument("--robot", type=int, action="append", default=[], metavar="ID", help="this one; repeat (all)")
    parser.add_argument(
        "--topics", type=pattern, action="append", default=[], metavar="PATTERN", help="as '/camera/**'; repeat (all)"
    )
    parser.add_argument("--tls-cert", type=Path, metavar="FILE", help="certificate (PEM), for wss://")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="its key (PEM, PKCS#8)")
    options.add_as_option(parser)
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    from bridge.foxglove import need_foxglove
    from bridge.recording import need_mcap

    need_foxglove()
    need_mcap()
    if not is_local(args.host) and args.publish:
        raise UsageError("whoever reaches this server could move robots: --host without --publish, or a tunnel to it")
    if (args.tls_cert is None) != (args.tls_key is None):
        raise UsageError("--tls-cert and --tls-key go together")
    if args.principal is not None and not args.principal.joins:
        raise UsageError("it is online: --as unity/5, or another agent with an id")
    settings = options.settings(args)
    return running.until_stopped(lambda: _show(args, settings))


async def _show(args: argparse.Namespace, settings: Settings) -> int:
    import asyncio

    import macs_zenoh
    from bridge.doctor.first import told_while_waiting
    from bridge.foxglove.live import Live
    from bridge.recording.recorder import Wanted
    from macs_zenoh.protocol.keyexpr import type_name

    tls = {}
    if args.tls_cert is not None:
        tls = {"tls_cert": _read(args.tls_cert), "tls_key": _read(args.tls_key)}
    kind, number = args.principal.agent if args.principal is not None else (2, 0)
    wanted = Wanted(frozenset(args.robot), tuple(args.topics), commands=False)
    waiting = told_while_waiting(settings.mesh)
    async with macs_zenoh.join(
        type_name(kind), id=number or None, settings=settings.mesh, on_waiting=waiting
    ) as agent:
        live = Live(agent, wanted, publishes=args.publish)
        try:
            port = live.start(args.host, args.port, **tls)
        except Exception as error:  # of the SDK's own kinds, as where the port is taken
            raise Unreachable(joined(args.host, args.port), str(error)) from error
        try:
            if args.publish:
                log.warning(
                    "whoever reaches this port may move robots, as may any web page in a browser on this machine"
                )
            running.say_ready(f"foxglove on {joined(args.host, port)}")
            await asyncio.Event().wait()
        finally:
            live.close()
    return 0


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(str(path), error.strerror or str(error)) from error


def _port(text: str) -> int:
    number = int(text) if text.isascii() and text.isdigit() and len(text) < 6 else -1
    if not 0 <= number <= 0xFFFF:
        raise argparse.ArgumentTypeError(f"{text!r} is no port from 0 to 65535")
    return number
