"""Show a mesh, live, in a terminal: robots and who has control of them, who is stopped; topics with rates and ages;
headsets with address, token and age; gateways, routers and the links between them; what was lost; what changes.

Keys: 1 to 6 choose what is shown, Tab goes on to the next; s sorts by the next column, r the other way; / filters,
arrows scroll, q ends it. It works over ssh and from 80 by 24 on. It joins nothing, and asks each robot at most once a
second and all of them together 60 times.

Where stdout is no terminal, and with --once, it prints what there is and ends; --json prints it for programs.

Exit code 0; 1: no router answers; 2: wrong usage.

examples:
  macs top -e tcp/192.168.1.10:7447
  macs top --view topics --filter /camera
  macs top --once --view headsets
  macs top --json | jq '.topics[] | select(.rate_hz < 5)'

what it prints:
  macs top tcp/192.168.1.10:7447  2 robots  3 others  1 gateways  1 routers  9 topics  1 STOPPED
  ROBOT  GROUP     RTT  USED  LOST/s  TOLD  STATE
      7      3   1.2ms     4     0.0  0.4s  STOPPED by unity/256"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from bridge.cli import observing, options, output, robots, running

if TYPE_CHECKING:
    from bridge.top.events import Event
    from bridge.top.observer import Observer
    from bridge.top.screen import Screen

SUMMARY = "the mesh, live: robots, topics, headsets, links"

VIEWS = ("robots", "topics", "headsets", "links", "lost", "events")
EVERY_S = 0.5
KEYS = {"\x1b[A": "up", "\x1b[B": "down", "\x1b[5~": "page up", "\x1b[6~": "page down"}
RATES_S = 1.2
"""Rates are known after the second look."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--view", choices=VIEWS, default="robots", help="what is shown first (default: robots)")
    parser.add_argument("--filter", metavar="TEXT", default="", help="only rows that have this in them")
    parser.add_argument("--once", action="store_true", help="print it once and end")
    parser.add_argument("--json", action="store_true", help="print all of it as one JSON object and end")
    observing.add_options(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    caller = robots.chosen_caller(args, settings.operator)
    live = not (args.once or args.json) and sys.stdout.isatty() and sys.stdin.isatty()

    async def top() -> int:
        from bridge.top.screen import Screen, View

        events: list[Event] = []
        async with observing.observed(settings, caller, args.wait, events.extend) as (observer, looking):
            view = View(args.view, pattern=args.filter)
            screen = Screen(observer.picture, view, where=", ".join(settings.mesh.routers))
            if live:
                await _live(screen, looking, events)
            else:
                await asyncio.wait([looking], timeout=RATES_S)
                output.say(output.as_json(facts(observer)) if args.json else _plain(screen))
        return 0

    return running.until_stopped(top)


async def _live(screen: Screen, looking: asyncio.Future[None], events: list[Event]) -> None:
    """Draw until q is pressed."""
    from rich.console import Console
    from rich.live import Live

    console = Console(file=sys.stdout, highlight=False, markup=False, emoji=False)
    pressed, ended = asyncio.Event(), asyncio.Event()

    def press(key: str) -> None:
        if not screen.view.press(key):
            ended.set()
        pressed.set()

    with _keys(press), Live(console=console, screen=True, auto_refresh=False) as live:
        while not ended.is_set() and not looking.done():
            screen.events.extend(events)
            events.clear()
            live.update(screen.draw(console.width, console.height, time.monotonic()), refresh=True)
            pressed.clear()
            waiting: list[asyncio.Future[Any]] = [asyncio.ensure_future(pressed.wait()), looking]
            await asyncio.wait(waiting, timeout=EVERY_S, return_when=asyncio.FIRST_COMPLETED)
            waiting[0].cancel()
    if looking.done():
        looking.result()


@contextmanager
def _keys(press: Callable[[str], None]) -> Iterator[None]:
    """Call ``press`` for each key on the terminal, at once and without showing it."""
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    loop = asyncio.get_running_loop()

    def read() -> None:
        with suppress(OSError):
            text = os.read(descriptor, 64).decode(errors="replace")
            if text in KEYS or not text.startswith("\x1b["):
                for key in [KEYS[text]] if text in KEYS else text:
                    press(key)

    tty.setcbreak(descriptor)
    loop.add_reader(descriptor, read)
    try:
        yield
    finally:
        loop.remove_reader(descriptor)
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _plain(screen: Screen) -> str:
    """The screen as text, as wide and high as it needs to be."""
    from rich.console import Console

    rows = 4 + len(screen.picture.topics) + len(screen.picture.robots) + len(screen.picture.others)
    console = Console(width=200, file=sys.stderr, highlight=False, markup=False, emoji=False)
    with console.capture() as captured:
        console.print(screen.draw(200, rows + len(screen.picture.programs), time.monotonic()))
    lines = [line.rstrip() for line in captured.get().split("\n")]
    while lines and (not lines[-1] or lines[-1].startswith("1 robots")):
        lines.pop()
    return "\n".join(lines)


def facts(observer: Observer) -> dict[str, Any]:
    """All of a picture, for programs."""
    picture, now = observer.picture, time.monotonic()
    return {
        "robots": [
            {
                "id": number,
                "group": row.info.group,
                "state": picture.state_of(row),
                "stopped": row.status.stopped if row.status else None,
                "round_trip_ms": None if row.round_trip_s is None else round(1000 * row.round_trip_s, 3),
                "link": _link(picture.link_of(row.info.zid, row.round_trip_s)),
                "told_s": round(now - row.told_s, 3) if row.status else None,
                "drops": dict(row.status.drops) if row.status else {},
            }
            for number, row in sorted(picture.robots.items())
        ],
        "topics": [
            {
                "robot": row.robot,
                "topic": row.name,
                "type": row.type,
                "way": "out" if row.role == "subscriber" else "in",
                "rate_hz": _rounded(row.rate_hz),
                "bytes_per_s": _rounded(row.rate_bytes),
                "age_s": row.age_s,
                "registrants": row.registrants,
                "control": row.holder,
            }
            for _, row in sorted(picture.topics.items())
        ],
        "headsets": [
            {
                "type": row.info.type_name,
                "id": row.info.id,
                "group": row.info.group,
                "zid": row.info.zid,
                "address": row.address,
                "token": row.token,
                "age_s": row.age_s,
                "away": row.away,
            }
            for row in picture.headsets()
        ],
        "programs": [
            {
                "kind": row.kind,
                "zid": row.zid,
                "address": row.address,
                "versions": row.versions,
                "round_trip_ms": None if row.round_trip_s is None else round(1000 * row.round_trip_s, 3),
                "answers": row.answers,
                "lost": row.lost,
                "links": sorted(row.links),
                "links_ms": {zid: _ms(took_s) for zid, took_s in sorted(row.links.items())},
                "link": _link(picture.link_of(row.zid, row.round_trip_s)),
            }
            for row in picture.programs.values()
        ],
    }


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(1000 * seconds, 3)


def _link(link: tuple[str, float | None] | None) -> dict[str, Any] | None:
    return None if link is None else {"router": link[0], "round_trip_ms": _ms(link[1])}


def _rounded(number: float | None) -> float | None:
    return None if number is None else round(number, 3)
