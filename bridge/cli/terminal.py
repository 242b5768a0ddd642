"""What people read: columns, colour and progress, drawn by rich. What goes into a pipe or a file is plain text, each
row whole and in one line, so that nothing is lost and nothing has to be parsed around.

NO_COLOR, FORCE_COLOR and TERM hold as everywhere, COLUMNS for a terminal. What others said passes the one filter
(`macs_zenoh.plain`) and is never read as rich's markup: text gets here as text and leaves as `rich.text.Text`.
Importing rich takes a moment, so it is imported when something is drawn.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bridge.cli import output
from macs_zenoh.plain import plain

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

WHOLE = 1 << 16
"""Columns of what has no width. A row of so much is not read by people."""

HEADING = "bold"
GOOD, ODD, BAD = "green", "yellow", "bold red"

Cell = str | tuple[str, str]
"""Text, or text with a style."""


@dataclass(frozen=True)
class Columns:
    """Rows whose cells stand below each other. A row may have fewer cells than others."""

    rows: Sequence[Sequence[Cell]]
    headings: Sequence[str] = ()
    right: Collection[int] = ()
    """Columns of numbers."""
    indent: int = 0
    gap: int = 2


Block = str | tuple[str, str] | Columns
"""A line, a line with a style, or columns."""


def show(*blocks: Block) -> None:
    """Blocks below each other, on stdout; of none nothing is said. Raises OutputLost."""
    if blocks:
        output.say(drawn(blocks, sys.stdout), coloured=True)


def drawn(blocks: Sequence[Block], stream: Any) -> str:
    """Blocks as this stream gets them. No character in them moves a cursor, but for those of rich's own colours."""
    from rich.console import Console

    page = _Page(terminal=stream.isatty())
    width = None if stream.isatty() else WHOLE  # whatever COLUMNS says: programs read a pipe
    console = Console(file=page, width=width, markup=False, emoji=False, highlight=False, legacy_windows=False)
    for block in blocks:
        console.print(_table(block) if isinstance(block, Columns) else _text(block))
    return "\n".join(line.rstrip() for line in page.getvalue().split("\n")).removesuffix("\n")


class _Page(io.StringIO):
    """What rich draws on: memory that says whether it stands for a terminal."""

    def __init__(self, *, terminal: bool) -> None:
        super().__init__()
        self._terminal = terminal

    def isatty(self) -> bool:
        return self._terminal


def _text(cell: Cell) -> Text:
    from rich.text import Text

    text, style = (cell, "") if isinstance(cell, str) else cell
    return Text(plain(text), style=style, overflow="fold")


def _table(columns: Columns) -> Table:
    from rich.table import Table

    table = Table.grid(padding=(0, columns.gap, 0, 0))
    count = max(len(row) for row in (columns.headings, *columns.rows))
    if columns.indent:
        table.add_column(min_width=columns.indent - columns.gap, no_wrap=True)
    for number in range(count):
        table.add_column(justify="right" if number in columns.right else "left", overflow="fold")
    before = [""] if columns.indent else []
    if columns.headings:
        table.add_row(*before, *(_text((heading, HEADING)) for heading in columns.headings))
    for row in columns.rows:
        table.add_row(*before, *(_text(cell) for cell in row))
    return table


Progress = Callable[[str, int, int], None]
"""(what is done now, steps done, of how many; 0: nobody knows)"""


@contextmanager
def progress() -> Iterator[Progress]:
    """Say on a terminal's stderr what is being done, in one line that is gone in the end; elsewhere nothing."""
    if not sys.stderr.isatty():
        yield lambda what, done, steps: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True, markup=False, emoji=False, highlight=False)
    shown = (TextColumn("{task.description}", markup=False), BarColumn(bar_width=20), MofNCompleteColumn())
    bar = Bar(*shown, console=console, transient=True, auto_refresh=False, redirect_stdout=False)
    with bar:
        task = bar.add_task("", total=None)

        def tell(what: str, done: int, steps: int) -> None:
            bar.update(task, description=plain(what), completed=done, total=steps or None, refresh=True)

        yield tell
