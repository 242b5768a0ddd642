"""Test any program against the protocol: a router by connecting to it, a headset by being its router.

Each check has a name and says what must hold; docs/conformance.md has them, and the bytes that they use. --level
compatible asks for what existing programs rely on, strict (the default) also for what the existing ones do badly.

Do not use it where robots move: it registers and broadcasts, and sends what is wrong on purpose.

Exit code 0: nothing failed; 1: a check failed, or nobody was there; 2: wrong usage.

examples:
  macs conformance gateway 127.0.0.1:7000                     a router; let robots in with macs gateway --robots any
  macs conformance gateway 127.0.0.1:7000 --level compatible
  macs conformance gateway --list                             what it would try
  macs conformance headset --listen 7000                      now start your headset, with this machine as its router
  macs conformance headset --listen 0 --run './headset 127.0.0.1 {port}' --junit headset.xml
  macs conformance headset --listen 7080 --web                one that comes by WebSocket

what it prints:
  failed  routing.broadcast: Type 0 without management data: to everybody. Copies: 1.
          0 came, 1 should have
  144 passed, 1 failed, 0 skipped"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bridge.cli import output, running
from macs_zenoh.errors import ConfigError, UsageError
from macs_zenoh.protocol.addresses import joined

if TYPE_CHECKING:
    from bridge.conformance.checks import Check, Verdict

SUMMARY = "hold a program of anybody's to the protocol"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    from bridge.headset import verbs  # light: no asyncio, no rosbags

    kinds = parser.add_subparsers(dest="judged", metavar="WHAT", required=True, title="what is judged")
    gateway = kinds.add_parser(
        "gateway", help="a router or gateway: connect to it", description=_judge_gateway.__doc__
    )
    gateway.add_argument(
        "target", metavar="HOST[:PORT]", nargs="?", type=verbs.parse_target, help="where it is (default port: 7000)"
    )
    gateway.add_argument(
        "--group", type=_group, default=200, metavar="G", help="use this group and the one above (default: 200)"
    )
    _add_common(gateway)
    gateway.set_defaults(judge=_judge_gateway)
    headset = kinds.add_parser("headset", help="a headset: be its router", description=_judge_headset.__doc__)
    headset.add_argument("--listen", type=int, metavar="PORT", help="where it shall connect to (0 for any free port)")
    headset.add_argument("--web", action="store_true", help="it comes by WebSocket, to ws://HOST:PORT/macs")
    headset.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    headset.add_argument(
        "--run",
        dest="command",
        metavar="COMMAND",
        help="start the headset with this, and again after what ended it; {port} is the port",
    )
    headset.add_argument(
        "--wait", type=float, default=30.0, metavar="S", help="how long to wait until it connects (default: 30)"
    )
    _add_common(headset)
    headset.set_defaults(judge=_judge_headset)


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--level",
        choices=["compatible", "strict"],
        default="strict",
        help="what existing programs rely on, or all of it (default: strict)",
    )
    parser.add_argument(
        "--patience", type=float, default=3.0, metavar="S", help="how long to wait for anything (default: 3)"
    )
    parser.add_argument("--list", action="store_true", help="the checks, and try none")
    parser.add_argument("--every", action="store_true", help="print those that passed or were skipped as well")
    parser.add_argument("--json", action="store_true", help="for programs: one object with all checks")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write JUnit's XML there too")


def _group(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 254:
        raise argparse.ArgumentTypeError(f"{text} is no group from 1 to 254")
    return int(text)


def run(args: argparse.Namespace) -> int:
    if args.patience <= 0:
        raise UsageError(f"--patience is {args.patience:g}, it must be more than 0")
    code: int = args.judge(args)
    return code


def _judge_gateway(args: argparse.Namespace) -> int:
    """Connect to a router as headsets and robots, and judge what each of them gets."""
    from bridge.conformance import gateway
    from bridge.conformance.checks import Level

    if args.list:
        return _list(args, gateway.CHECKS)
    if args.target is None:
        raise UsageError("where is it? HOST:PORT is missing")
    host, port = args.target

    async def judge() -> int:
        began = time.monotonic()
        found = await gateway.judge(host, port, level=Level(args.level), patience_s=args.patience, group=args.group)
        return _report(args, found, time.monotonic() - began)

    return running.until_stopped(judge, interrupted=running.INTERRUPTED)


def _judge_headset(args: argparse.Namespace) -> int:
    """Be the router of a headset, and judge what it says and what it outlives. It should connect again by itself, or
    --run says how to start it. Of what it never does, as registering or serving, nothing is judged."""
    from bridge.conformance import headset
    from bridge.conformance.checks import Level
    from bridge.conformance.program import Command

    if args.list:
        return _list(args, headset.CHECKS)
    if args.listen is None:
        raise UsageError("where shall it connect to? --listen PORT is missing")
    program = None if args.command is None else Command(args.command)

    async def judge() -> int:
        began = time.monotonic()
        try:
            found = await headset.judge(
                args.host,
                args.listen,
                level=Level(args.level),
                patience_s=args.patience,
                start_s=args.wait,
                on_listening=lambda port: output.note(f"listening on {joined(args.host, port)}: connect the headset"),
                program=program,
                web=args.web,
            )
        finally:
            if program is not None:
                await program.stop()
        return _report(args, found, time.monotonic() - began)

    return running.until_stopped(judge, interrupted=running.INTERRUPTED)


def _list(args: argparse.Namespace, checks: Sequence[Check]) -> int:
    from bridge.conformance import report
    from bridge.conformance.checks import Level

    asked = [check for check in checks if args.level == "strict" or check.level is Level.COMPATIBLE]
    if args.json:
        output.say(output.as_json([report.described(check) for check in asked]))
    else:
        output.say("\n".join(report.list_lines(asked)))
    return 0


def _report(args: argparse.Namespace, found: Sequence[Verdict], seconds: float) -> int:
    from bridge.conformance import report
    from bridge.conformance.checks import Level, Outcome

    level = Level(args.level)
    if args.junit is not None:
        try:
            args.junit.write_text(report.as_junit(args.judged, level, found, seconds), encoding="utf-8")
        except OSError as error:
            raise ConfigError(str(args.junit), error.strerror or str(error)) from error
    if args.json:
        output.say(output.as_json(report.as_data(args.judged, level, found, seconds)))
    else:
        output.say("\n".join(report.as_lines(found, every=args.every)))
    return 1 if any(verdict.outcome is Outcome.FAILED for verdict in found) else 0
