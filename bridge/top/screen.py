"""A picture of a mesh on a terminal: a view at a time, sorted and filtered, from 80 by 24 on. Drawn by rich."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from bridge.graph.rates import bytes_of
from macs_zenoh.plain import plain

from .events import SHORT, Event
from .picture import Picture

VIEWS = ("robots", "topics", "headsets", "links", "lost", "events")
HELP = "1 robots 2 topics 3 headsets 4 links 5 lost 6 events  s r sort  / filter  ↑↓  q quit"
EVENTS = 200
SILENT = "does not answer"
STALE_S = 5.0
"""What a robot told longer ago is shown as old."""

Row = tuple[tuple[Any, ...], tuple[str, ...], str]
"""What it is sorted by, its cells, and a style."""
Links = list[tuple[str, float | None]]
"""By the session at the other end, with the round trip of the link."""


@dataclass
class View:
    """What somebody looks at: which view, by which column it is sorted, and what it is filtered by."""

    name: str = "robots"
    column: int = 0
    reverse: bool = False
    pattern: str = ""
    first: int = 0
    typing: bool = False
    """Whether what is typed goes to the filter."""

    def press(self, key: str) -> bool:
        """A key, as a character or the name of one; whether to go on."""
        if self.typing:
            self._type(key)
        elif key in ("q", "\x03", "\x04"):
            return False
        elif key.isdigit() and 1 <= int(key) <= len(VIEWS):
            self.name, self.column, self.reverse, self.first = VIEWS[int(key) - 1], 0, False, 0
        elif key == "\t":
            self.press(str(_next(self.name)))
        elif key == "s":
            self.column += 1
        elif key == "r":
            self.reverse = not self.reverse
        elif key == "/":
            self.typing, self.pattern = True, ""
        elif key in ("up", "down", "page up", "page down"):
            self.first = max(0, self.first + {"up": -1, "down": 1, "page up": -10, "page down": 10}[key])
        return True

    def _type(self, key: str) -> None:
        if key in ("\r", "\n", "\x1b"):
            self.typing = False
            self.pattern = "" if key == "\x1b" else self.pattern
        elif key in ("\x7f", "\b"):
            self.pattern = self.pattern[:-1]
        elif len(key) == 1 and key.isprintable() and len(self.pattern) < 64:
            self.pattern += key
        self.first = 0


def _next(name: str) -> int:
    return (VIEWS.index(name) + 1) % len(VIEWS) + 1


@dataclass
class Screen:
    """Draws. ``rows`` is how many of a table there were in the end."""

    picture: Picture
    view: View = field(default_factory=View)
    events: deque[Event] = field(default_factory=lambda: deque(maxlen=EVENTS))
    where: str = ""

    def draw(self, width: int, height: int, now: float) -> Group:
        """All of the screen, for a terminal of this size."""
        headings, right, rows = self._rows(now)
        view = self.view
        if view.pattern:
            rows = [row for row in rows if any(view.pattern.lower() in cell.lower() for cell in row[1])]
        column = view.column % len(headings)
        if view.name != "events":
            rows.sort(key=lambda row: _sortable(row[0][column]), reverse=view.reverse)
        space = max(1, height - 4)
        view.first = min(view.first, max(0, len(rows) - space))
        shown = rows[view.first : view.first + space]
        table = _table(headings, right, column if view.name != "events" else -1, view.reverse, shown, width)
        return Group(self._head(width), table, *[Text("")] * (space - len(shown)), self._foot(len(rows), space, width))

    def _head(self, width: int) -> Text:
        picture = self.picture
        stopped = sum(bool(row.status and row.status.stopped) for row in picture.robots.values())
        kinds = [row.kind for row in picture.programs.values()]
        counts = (
            f"macs top {self.where}  {len(picture.robots)} robots  {len(picture.others)} others  "
            f"{kinds.count('gateway')} gateways  {kinds.count('router')} routers  {len(picture.topics)} topics"
        )
        head = Text(plain(counts)[:width], style="bold", no_wrap=True, overflow="crop")
        if stopped:
            head.append(f"  {stopped} STOPPED", style="bold red")
        return head

    def _foot(self, count: int, space: int, width: int) -> Text:
        view = self.view
        if view.typing or view.pattern:
            text = f"filter: {view.pattern}{'_' if view.typing else ''}   (Enter keeps it, Esc ends it)"
        else:
            text = HELP
        if count > space:
            text = f"{view.first + 1}-{min(count, view.first + space)} of {count}  {text}"
        return Text(plain(text)[:width], style="dim", no_wrap=True, overflow="crop")

    def _rows(self, now: float) -> tuple[Sequence[str], set[int], list[Row]]:
        make: dict[str, Callable[[float], tuple[Sequence[str], set[int], list[Row]]]] = {
            "robots": self._robots,
            "topics": self._topics,
            "headsets": self._headsets,
            "links": self._links,
            "lost": self._lost,
            "events": self._events,
        }
        return make[self.view.name](now)

    def _robots(self, now: float) -> tuple[Sequence[str], set[int], list[Row]]:
        rows: list[Row] = []
        for number, row in self.picture.robots.items():
            state = self.picture.state_of(row)
            age_s = now - row.told_s if row.status is not None else None
            nodes = sum(bool(node.registrants) for node in row.status.nodes) if row.status else 0
            bad = bool(row.status and row.status.stopped) or "answer" in state
            style = "bold red" if bad else "yellow" if row.lost_per_s else ""
            keys = (number, row.info.group, row.round_trip_s, nodes, row.lost_per_s, age_s, state)
            cells = (
                str(number),
                str(row.info.group or "-"),
                _ms(row.round_trip_s),
                str(nodes),
                f"{row.lost_per_s:.1f}" if row.status else "-",
                _age(age_s),
                state or "-",
            )
            rows.append((keys, cells, style))
        return ("ROBOT", "GROUP", "RTT", "USED", "LOST/s", "TOLD", "STATE"), {0, 1, 2, 3, 4, 5}, rows

    def _topics(self, now: float) -> tuple[Sequence[str], set[int], list[Row]]:
        rows: list[Row] = []
        for row in self.picture.topics.values():
            way = "out" if row.role == "subscriber" else "in"
            keys = (row.robot, row.name, way, row.rate_hz, row.rate_bytes, row.age_s, len(row.registrants), row.holder)
            cells = (
                str(row.robot),
                row.name,
                way,
                "-" if row.rate_hz is None else f"{row.rate_hz:.1f}",
                "-" if row.rate_bytes is None else f"{bytes_of(row.rate_bytes)}/s",
                _age(row.age_s),
                str(len(row.registrants)),
                row.holder or "-",
            )
            rows.append((keys, cells, "dim" if row.rate_hz == 0 else ""))
        return ("ROBOT", "TOPIC", "WAY", "Hz", "DATA", "AGE", "USERS", "CONTROL"), {0, 3, 4, 5, 6}, rows

    def _headsets(self, now: float) -> tuple[Sequence[str], set[int], list[Row]]:
        rows: list[Row] = []
        for row in self.picture.headsets():
            info = row.info
            keys = (info.id, info.type_name, info.group, row.address, row.token, row.age_s, info.zid, row.away)
            cells = (
                str(info.id),
                info.type_name,
                str(info.group or "-"),
                row.address or "-",
                row.token or "-",
                _age(row.age_s),
                info.zid[:SHORT],
                "away" if row.away else "-",
            )
            rows.append((keys, cells, "yellow" if row.away else ""))
        return ("ID", "TYPE", "GROUP", "ADDRESS", "TOKEN", "AGE", "SESSION", "STATE"), {0, 2, 5}, rows

    def _links(self, now: float) -> tuple[Sequence[str], set[int], list[Row]]:
        """Programs by the way to them, and each link by its own round trip."""
        rows: list[Row] = []

        def add(kind: str, zid: str, name: str, trip: float | None, lost: int, links: Links, note: str) -> None:
            told = [f"{other[:SHORT]} {_ms(took_s)}" for other, took_s in links]
            what = ", ".join([*told, *([note] if note else [])]) or "-"
            longest = max((took_s for _, took_s in links if took_s is not None), default=None)
            keys = (kind, zid, name, trip, lost, longest)
            rows.append(
                (keys, (kind, zid[:SHORT], name, _ms(trip), str(lost), what), "" if note != SILENT else "bold red")
            )

        for row in self.picture.programs.values():
            behind = sum(info.zid == row.zid for info in self.picture.others.values())
            link = self.picture.link_of(row.zid, row.round_trip_s)
            links = list(row.links.items()) if row.kind == "router" else [link] if link else []
            note = SILENT if not row.answers else "" if row.kind == "router" else f"{behind} agents"
            add(row.kind, row.zid, row.address or "?", row.round_trip_s, row.lost, links, note)
        for number, robot in self.picture.robots.items():
            link = self.picture.link_of(robot.info.zid, robot.round_trip_s)
            lost = sum(robot.status.drops.values()) if robot.status else 0
            add("robot", robot.info.zid, f"robot {number}", robot.round_trip_s, lost, [link] if link else [], "")
        return ("KIND", "SESSION", "ADDRESS", "RTT", "LOST", "LINKED WITH"), {3, 4}, rows

    def _lost(self, now: float) -> tuple[Sequence[str], set[int], list[Row]]:
        rows: list[Row] = []
        for row in self.picture.losses():
            cells = (str(row.robot), row.counter, str(row.count), f"{row.per_s:.1f}")
            rows.append(((row.robot, row.counter, row.count, row.per_s), cells, "yellow" if row.per_s else ""))
        return ("ROBOT", "COUNTER", "LOST", "LOST/s"), {0, 2, 3}, rows

    def _events(self, now: float) -> tuple[Sequence[str], set[int], list[Row]]:
        rows: list[Row] = []
        for event in reversed(self.events):
            at = time.strftime("%H:%M:%S", time.localtime(event.at_s))
            style = "bold red" if event.what in ("stopped", "silent", "dead-man") else ""
            rows.append(((event.at_s, event.what, event.text), (at, event.what, event.text), style))
        return ("TIME", "EVENT", "WHAT"), set(), rows


def _table(
    headings: Sequence[str], right: set[int], column: int, reverse: bool, rows: Sequence[Row], width: int
) -> Table:
    table = Table.grid(padding=(0, 2, 0, 0))
    table.width = width
    for number in range(len(headings)):
        last = number == len(headings) - 1
        table.add_column(justify="right" if number in right else "left", no_wrap=True, ratio=1 if last else None)
    mark = "▼" if reverse else "▲"
    table.add_row(
        *(Text(f"{name}{mark if number == column else ''}", style="bold") for number, name in enumerate(headings))
    )
    for _, cells, style in rows:
        table.add_row(*(Text(plain(cell), style=style, no_wrap=True, overflow="ellipsis") for cell in cells))
    return table


def _sortable(value: Any) -> tuple[int, Any]:
    """What is not known comes last, whatever else there is."""
    return (1, 0) if value is None else (0, value)


def _ms(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1000 * seconds:.1f}ms"


def _age(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    if seconds < 100:
        return f"{seconds:.1f}s"
    return f"{seconds / 60:.0f}m" if seconds < 6000 else f"{seconds / 3600:.0f}h"
