"""Show where the time of a topic's messages goes, hop by hop: from the ROS node to the robot's agent, into Zenoh, to
each router, to the gateway, through it, into headsets' sockets. With --commands the other way: from a headset's socket
to the robot.

While it runs, the robot marks one in --every messages, Zenoh and its routers stamp those, and gateways note them;
nothing else changes, and afterwards nothing is marked. The topic is received here as well, so that there is something
to see where no headset takes it; commands are only watched, so somebody has to send them. Clocks of programs are
compared by pings; a router's by the order in which messages pass. How well each is known is printed.

Exit code 0; 1: no message was traced, no router answers, no such topic; 2: wrong usage; 130: Ctrl-C before the first.

examples:
  macs trace /pose --robot 7
  macs trace /camera/image --robot 7 --every 10 --seconds 30 --json
  macs trace /cmd_vel --robot 7 --commands

what it prints:
  /pose of robot 7 to gateway 10.0.0.5:7000: 100 messages, 96 at once
  HOP                                            MEAN     P50     P99
  robot 7: ROS to its agent                     0.213   0.201   0.402
  robot 7 to router d8c1f2aa                    0.154   0.149   0.233
  gateway 10.0.0.5:7000: handled                0.061   0.058   0.110
  end to end                                    0.640   0.611   0.988  ms
  clocks: robot 7 within 0.21 ms, router d8c1f2aa within 0.15 ms"""

from __future__ import annotations

import argparse
import asyncio
from typing import TYPE_CHECKING, Any

from bridge.cli import named, output, terminal
from macs_zenoh.errors import Unreachable, UsageError
from macs_zenoh.plain import plain

if TYPE_CHECKING:
    from bridge.graph.site import Site
    from bridge.graph.traces import Traced

SUMMARY = "where the time of messages goes, hop by hop"

SECONDS = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("topic", metavar="TOPIC", help="its name, as /pose")
    parser.add_argument("--commands", action="store_true", help="what is sent to the robot, instead of what it sends")
    parser.add_argument("--every", type=named.number, default=1, metavar="N", help="one in N messages (default: 1)")
    parser.add_argument("--count", type=named.number, metavar="N", help="end after N messages")
    parser.add_argument(
        "--seconds", type=named.positive, default=SECONDS, metavar="S", help=f"end after S (default: {SECONDS:g})"
    )
    named.add_site_options(parser, robots_are="the only one that is online")


def run(args: argparse.Namespace) -> int:
    async def work(site: Site) -> int:
        from bridge.graph import traces

        robots = site.only()
        if len(robots) != 1:
            raise UsageError("one robot at a time: --robot 7")
        tracing = traces.Tracing(site, robots[0], args.topic, every=args.every, commands=args.commands)
        await tracing.begin()
        stopped = False
        try:
            await tracing.collect(seconds=args.seconds, count=args.count)
        except asyncio.CancelledError:  # what has come until now is told
            stopped = True
        found = await tracing.conclude()
        await tracing.end()
        if not found and stopped:
            raise asyncio.CancelledError
        if not found:
            why = "nobody has sent a command" if args.commands else "no message has come"
            raise Unreachable(f"{args.topic} of robot {robots[0]}", f"{why} that was traced")
        for traced in found:
            if args.json:
                named.emit(traced.facts())
            else:
                _show(traced)
        return 0

    return named.on_site(args, work)


def _show(traced: Traced) -> None:
    rows: list[list[Any]] = [
        [row.hop, *(f"{value:.3f}" for value in (row.mean_ms, row.p50_ms, row.p99_ms))] for row in traced.rows
    ]
    rows[-1].append("ms")
    terminal.show(
        f"{traced.title}: {traced.count} messages, {traced.at_once} at once",
        terminal.Columns(rows, headings=["HOP", "MEAN", "P50", "P99"], right={1, 2, 3}),
    )
    output.say(plain(f"clocks: {traced.clocks_text}") + "\n")
