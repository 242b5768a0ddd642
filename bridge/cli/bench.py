"""Measure rate, loss and latency through this mesh, politely: within limits, and with messages of the lowest priority.

Without --robot two sessions of this program send from one to the other, through the router: one way, by one clock.
With --robot the robot's agent sends each message back. Nothing is asked of ROS, and nothing moves.

At most 10 MB a second, 2000 messages a second and 60 seconds; to find the limits of a mesh, measure one that nobody
uses (`python -m benchmarks`).

Exit code 0: done; 1: no router answers, nothing comes through, or --most-lost or --most-ms was exceeded; 2: wrong
usage; 130: Ctrl-C before the end.

examples:
  macs bench
  macs bench --robot 7 --rate 50 --size 200
  macs bench --seconds 30 --most-lost 0.1 --most-ms 5 && echo good enough

what it prints:
  through the router: 500 messages of 1000 bytes, 100.0 a second
  lost 0 (0.00%)   latency p50 0.412 ms   p99 0.901 ms   max 1.204 ms"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from bridge.cli import named, options, output, robots, running, terminal
from macs_zenoh.errors import MacsError, NotServed, Unreachable, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridge.graph.probes import Load, Outcome
    from bridge.settings import Settings

    Tell = Callable[[int, int], None]

SUMMARY = "rate, loss and latency through this mesh"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", type=named.robot_ids, metavar="ID", help="there and back, by this robot's agent")
    parser.add_argument(
        "--rate", type=named.positive, default=100.0, metavar="HZ", help="so many a second (default: 100)"
    )
    parser.add_argument("--size", type=named.number, default=1000, metavar="BYTES", help="of each (default: 1000)")
    parser.add_argument("--seconds", type=named.positive, default=5.0, metavar="S", help="so long (default: 5)")
    parser.add_argument("--most-lost", type=named.positive, metavar="PERCENT", help="exit code 1 when more is lost")
    parser.add_argument("--most-ms", type=named.positive, metavar="MS", help="exit code 1 when the p99 is longer")
    parser.add_argument("--json", action="store_true", help="for programs: one object")
    parser.add_argument(
        "--wait", type=named.positive, default=5.0, metavar="S", help="for a router, then for each answer (default: 5)"
    )
    options.add_as_option(parser)
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    if args.robot is not None and len(args.robot) != 1:
        raise UsageError("one robot at a time: --robot 7")

    async def bench() -> int:
        from bridge.graph.probes import Load

        load = Load(args.rate, args.size, args.seconds)
        load.check()
        with terminal.progress() as progress:
            outcome = await _measure(settings, args, load, lambda sent, of: progress("measuring", sent, of))
        return _tell(args, load, outcome)

    return running.until_stopped(bench, interrupted=running.INTERRUPTED)


async def _measure(settings: Settings, args: argparse.Namespace, load: Load, tell: Tell) -> Outcome:
    from bridge.graph import probes

    if args.robot:
        caller = robots.chosen_caller(args, settings.operator)
        async with robots.operator(settings.mesh, caller, timeout_s=args.wait) as operator:
            robot = args.robot[0]
            try:  # where it is not there, that is said at once
                await operator.ask(robot, "ping", timeout_s=args.wait)
            except NotServed:
                raise Unreachable(f"robot {robot}", operator.not_answered) from None
            return await probes.round_trips(
                lambda data: operator.ask(robot, "ping", data, timeout_s=args.wait), load, tell
            )
    async with (
        robots.session(settings.mesh, timeout_s=args.wait) as first,
        robots.session(settings.mesh, timeout_s=args.wait) as second,
    ):
        return await probes.through(first, second, load, tell)


def _tell(args: argparse.Namespace, load: Load, outcome: Outcome) -> int:
    facts = outcome.facts()
    lost = 100 * (outcome.sent - outcome.received) / max(1, outcome.sent)
    where = f"robot {args.robot[0]}, there and back" if args.robot else "through the router"
    if args.json:
        named.emit({"robot": args.robot[0] if args.robot else None, "size": load.size, **facts})
    else:
        output.say(f"{where}: {outcome.sent} messages of {load.size} bytes, {facts['rate_hz']} a second")
        latency = "   ".join(f"{name} {facts[f'{name}_ms']} ms" for name in ("p50", "p99", "max"))
        output.say(f"lost {outcome.sent - outcome.received} ({lost:.2f}%)   latency {latency}")
    if not outcome.received:
        raise MacsError("nothing came through")
    slow = args.most_ms is not None and (facts["p99_ms"] or 0) > args.most_ms
    return 1 if slow or (args.most_lost is not None and lost > args.most_lost) else 0
