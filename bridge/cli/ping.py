"""Measure how long a robot takes to answer, through all that lies between: router, links, its agent. As `ping` does
for hosts.

Nothing is asked of ROS, and nothing moves. The robot's clock is compared with this host's on the way; how well that is
known is half of the shortest round trip.

Exit code 0: it answered at least once; 1: it never did, is not online, or no router answers; 2: wrong usage; 130:
Ctrl-C before the first answer.

examples:
  macs ping 7
  macs ping 7 --count 100 --interval 0.1 --size 1000
  macs ping 7 --json | jq .p99_ms

what it prints:
  56 bytes from robot 7: seq=1 time=1.204 ms
  4 sent, 4 answered, 0% lost
  rtt min/avg/max/mdev = 1.102/1.188/1.301/0.071 ms
  its clock is 0.412 ms ahead of ours, within 0.551 ms"""

from __future__ import annotations

import argparse
import asyncio
import time
from typing import TYPE_CHECKING, Any

from bridge.cli import named, options, output, robots, running
from macs_zenoh.errors import CallTimeout, MacsError, NotServed, Unreachable
from macs_zenoh.protocol.messages import ROS

if TYPE_CHECKING:
    from bridge.cli.robots import Operator

SUMMARY = "how long a robot takes to answer"

MOST_BYTES = 1 << 16


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("robot", metavar="ROBOT", type=_robot, help="its id")
    parser.add_argument("--count", type=named.number, default=4, metavar="N", help="so often (default: 4)")
    parser.add_argument(
        "-i",
        "--interval",
        type=_interval,
        default=1.0,
        metavar="S",
        help="pause (default: 1, at least 0.01)",
    )
    parser.add_argument("--size", type=_size, default=56, metavar="BYTES", help="there and back (default: 56)")
    parser.add_argument("--json", action="store_true", help="for programs: one object in the end")
    parser.add_argument(
        "--wait", type=named.positive, default=5.0, metavar="S", help="for a router, then for each answer (default: 5)"
    )
    options.add_as_option(parser)
    options.add_mesh_options(parser)


def _robot(text: str) -> int:
    (robot,) = named.robot_ids(text) or [0]
    return robot


def _interval(text: str) -> float:
    if (value := named.positive(text)) < 0.01:
        raise argparse.ArgumentTypeError(f"{text} s is too short, at least 0.01 are allowed")
    return value


def _size(text: str) -> int:
    if (value := named.number(text)) > MOST_BYTES:
        raise argparse.ArgumentTypeError(f"{text} bytes are too many, at most {MOST_BYTES} are allowed")
    return value


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    caller = robots.chosen_caller(args, settings.operator)

    async def ping() -> int:
        async with robots.operator(settings.mesh, caller, timeout_s=args.wait) as operator:
            return await _ping(operator, args)

    return running.until_stopped(ping, interrupted=running.INTERRUPTED)


async def _ping(operator: Operator, args: argparse.Namespace) -> int:
    from bridge.graph.probes import Times, summary

    times, sent, problem = Times(), 0, ""
    online = [each for each in await operator.online() if each.type == ROS]
    found = next((each for each in online if each.id == args.robot), None)
    if found is None:
        elsewhere = "" if online else robots.here(await operator.elsewhere())
        raise Unreachable(f"robot {args.robot}", f"it is not online{elsewhere} (macs ls)")
    data = bytes(args.size)
    try:
        for number in range(1, args.count + 1):
            sent, began = number, time.monotonic()
            try:
                await operator.ask(args.robot, "ping", data, timeout_s=args.wait)
            except CallTimeout as error:
                problem = str(error)
                _say(args, f"no answer from robot {args.robot}: seq={number}")
            except NotServed:
                problem = operator.not_answered
                break
            except MacsError as error:
                problem = str(error)
                break
            else:
                times.taken_s.append(time.monotonic() - began)
                _say(args, f"{args.size} bytes from robot {args.robot}: seq={number} time={_ms(times.taken_s[-1])} ms")
            if number < args.count:
                await asyncio.sleep(max(0.0, began + args.interval - time.monotonic()))
    except asyncio.CancelledError:
        if not times.taken_s:
            raise
    clock = await operator.clock(found.zid)
    lost = sent - len(times.taken_s)
    if args.json:
        said: dict[str, Any] = {"robot": args.robot, "sent": sent, "answered": len(times.taken_s), **times.facts()}
        if clock is not None:
            said |= {"clock_ahead_ms": round(1000 * clock[0], 3), "clock_within_ms": round(1000 * clock[1], 3)}
        named.emit(said)
    elif times.taken_s:
        output.say(f"{sent} sent, {len(times.taken_s)} answered, {100 * lost / sent:.0f}% lost")
        output.say(summary(times.taken_s))
        if clock is not None:
            how = "ahead of" if clock[0] >= 0 else "behind"
            output.say(f"its clock is {_ms(abs(clock[0]))} ms {how} ours, within {_ms(clock[1])} ms")
    if not times.taken_s and not args.json:
        raise Unreachable(f"robot {args.robot}", problem or "no answer")
    return 0 if times.taken_s else 1


def _say(args: argparse.Namespace, line: str) -> None:
    if not args.json:
        output.say(line)


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.3f}"
