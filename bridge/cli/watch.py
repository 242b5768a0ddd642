"""Print a line for each thing that changes on a mesh, as it happens, until Ctrl-C: who came and left, which robot was
stopped and released and by whom, who has control, what was refused or lost, who failed over.

It joins nothing and asks each robot at most once a second, so what lasts shorter is told late, or together. Who may
ask robots for their state, and see tokens, sees all of it (--as).

Exit code 0 after Ctrl-C, or when --count or --timeout has been reached; 1: no router answers, or fewer events than
--count in --timeout; 2: wrong usage.

examples:
  macs watch
  macs watch --only stopped,released,control
  macs watch --json | jq 'select(.event == "refused")'

what it prints:
  2026-05-04T12:30:01+0200 came      unity/256 is online in group 3 (session 9f2d07e1)
  2026-05-04T12:30:09+0200 stopped   ros/7 was stopped by unity/256
  {"time": 1777890609.412, "event": "stopped", "who": "ros/7", "by": "unity/256", "text": "..."}     with --json"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Any

from bridge.cli import named, observing, options, output, robots, running
from macs_zenoh.plain import plain
from macs_zenoh.timeouts import within

if TYPE_CHECKING:
    from bridge.top.events import Event

SUMMARY = "a line for each thing that changes on the mesh"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="for programs: a JSON object in each line")
    parser.add_argument("--only", metavar="EVENTS", default="", help="only these, as stopped,released,control")
    named.add_end_options(parser)
    observing.add_options(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    caller = robots.chosen_caller(args, settings.operator)
    only = _only(args.only)

    async def watch() -> int:
        told = 0
        enough = asyncio.Event()

        def tell(events: list[Event]) -> None:
            nonlocal told
            for event in events:
                if (only and event.what not in only) or (args.count and told >= args.count):
                    continue
                told += 1
                named.emit(event.facts()) if args.json else output.say(_line(event))
            if args.count and told >= args.count:
                enough.set()

        async with observing.observed(settings, caller, args.wait, tell) as (_, looking):
            output.note("watching; Ctrl-C ends it")
            with contextlib.suppress(asyncio.TimeoutError):
                await within(_either(looking, enough), args.timeout)
        return 1 if args.count and told < args.count else 0

    return running.until_stopped(watch)


async def _either(looking: asyncio.Future[None], enough: asyncio.Event) -> None:
    waiting: asyncio.Future[bool] = asyncio.ensure_future(enough.wait())
    try:
        both: set[asyncio.Future[Any]] = {looking, waiting}
        await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        if looking.done():
            looking.result()
    finally:
        waiting.cancel()


def _only(text: str) -> frozenset[str]:
    from bridge.top.events import KINDS
    from macs_zenoh.errors import UsageError

    wanted = frozenset(word for word in text.split(",") if word)
    if unknown := sorted(wanted - set(KINDS)):
        raise UsageError(f"{unknown[0]!r} is no event: there are {', '.join(KINDS)}")
    return wanted


def _line(event: Event) -> str:
    at = time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(event.at_s))
    return plain(f"{at} {event.what:10}{event.text}")
