"""Show a mesh in Foxglove or Lichtblick, live: robots' topics as they are, who is there, stops, control, refusals.

Open ws://127.0.0.1:8765 there (Open connection, Foxglove WebSocket). A robot is asked for a topic while somebody looks
at it. Web pages from elsewhere are refused unless --origin names them, as https://app.foxglove.dev; programs of this
machine are not. With --tokens each client shows a token that `macs token` made, in the address since Foxglove has no
other place: ws://HOST:8765/?token=macs_... It is for all that is shown; what is published and called needs its rights.
Other users of THIS machine can look without one: the SDK's server, behind ours, listens on a port of 127.0.0.1.

It only shows, unless it has --publish: then the publish and service panels work on /ROBOT/TOPIC, and MAY MOVE ROBOTS,
as far as their rules, control, dead-man and emergency stop let a headset do so.

examples:
  macs foxglove -e tcp/192.168.1.10:7447
  macs foxglove --robot 7 --topics '/camera/**' --port 9000
  macs foxglove --robot 7 --publish --origin https://app.foxglove.dev
  macs foxglove --host 0.0.0.0 --tls-cert cert.pem --tls-key key.pem --tokens ~/.config/macs/tokens.json --publish

what it prints:
  ready: foxglove on 127.0.0.1:8765"""

from __future__ import annotations

import argparse
import logging
import socket
import ssl
from pathlib import Path

from bridge import memory
from bridge.cli import options, running
from bridge.cli.amounts import pattern
from bridge.settings import Settings
from bridge.tokens.store import path_of
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
        help="clients may publish and call services, which may move robots",
    )
    parser.add_argument("--robot", type=int, action="append", default=[], metavar="ID", help="this one; repeat (all)")
    parser.add_argument(
        "--topics", type=pattern, action="append", default=[], metavar="PATTERN", help="as '/camera/**'; repeat (all)"
    )
    parser.add_argument(
        "--tokens",
        metavar="FILE",
        help="each client shows a token of this file of `macs token`; users of this machine can look without",
    )
    parser.add_argument(
        "--origin", action="append", default=[], metavar="ORIGIN", help="web pages from there may come; repeat"
    )
    parser.add_argument(
        "--name", action="append", default=[], metavar="HOST", help="browsers may call this machine so; repeat"
    )
    parser.add_argument("--tls-cert", type=Path, metavar="FILE", help="certificate (PEM), for wss://")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="its key (PEM)")
    options.add_as_option(parser)
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    from bridge.foxglove import need_foxglove
    from bridge.recording import need_mcap

    need_foxglove()
    need_mcap()
    if not is_local(args.host) and args.publish and args.tokens is None:
        raise UsageError("whoever reaches it could move robots: --tokens FILE, --host without --publish, or a tunnel")
    if (args.tls_cert is None) != (args.tls_key is None):
        raise UsageError("--tls-cert and --tls-key go together")
    if args.principal is not None and not args.principal.joins:
        raise UsageError("it is online: --as unity/5, or another agent with an id")
    settings = options.settings(args)
    memory.give_back()
    return running.until_stopped(lambda: _show(args, settings))


async def _show(args: argparse.Namespace, settings: Settings) -> int:
    import asyncio
    import secrets

    import macs_zenoh
    from bridge.doctor.first import told_while_waiting
    from bridge.foxglove.live import Live
    from bridge.foxglove.relay import Relay, own_certificate
    from bridge.recording.recorder import Wanted
    from bridge.tokens.watch import Watch
    from macs_zenoh.protocol.keyexpr import type_name

    outside = _context(args.tls_cert, args.tls_key)
    certificate, key, inside = own_certificate()
    kind, number = args.principal.agent if args.principal is not None else (2, 0)
    wanted = Wanted(frozenset(args.robot), tuple(args.topics), commands=False)
    waiting = told_while_waiting(settings.mesh)
    secret = f"/{secrets.token_hex(32)}" if args.publish else None
    async with macs_zenoh.join(
        type_name(kind), id=number or None, settings=settings.mesh, on_waiting=waiting
    ) as agent:
        live = Live(agent, wanted, secret=secret)
        port = live.start("127.0.0.1", 0, tls_cert=certificate, tls_key=key)
        watch = None if args.tokens is None else Watch(path_of(args.tokens), lambda: relay.look())
        names = {socket.gethostname().lower(), *(name.lower() for name in args.name)}
        relay = Relay(port, inside, secret, tokens=watch, origins=args.origin, names=names, robots=wanted.robots)
        try:
            port = await relay.open(args.host, args.port, outside)
            if watch is not None:
                watch.start()
            if args.publish and watch is None:
                log.warning(
                    "whoever reaches this port may move robots: programs, and pages of %s", args.origin or "none"
                )
            running.say_ready(f"foxglove on {joined(args.host, port)}")
            await asyncio.Event().wait()
        except OSError as error:
            raise Unreachable(joined(args.host, args.port), error.strerror or str(error)) from error
        finally:
            if watch is not None:
                watch.close()
            await relay.close()
            live.close()
    return 0


def _context(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    if certificate is None or key is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(str(certificate), f"cannot be used with {key}: {error.strerror or error}") from error
    return context


def _port(text: str) -> int:
    number = int(text) if text.isascii() and text.isdigit() and len(text) < 6 else -1
    if not 0 <= number <= 0xFFFF:
        raise argparse.ArgumentTypeError(f"{text!r} is no port from 0 to 65535")
    return number
