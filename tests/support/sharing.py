"""How the tests of a parallel run are shared out: by name, pure but for the scheduler at the end.

A test is handed to whichever worker is free. Tests of pages share a site, and those of a worker its browser, which
take more of a machine than the tests themselves: so few workers have all of them. What takes long comes first, so that
nobody waits for it at the end; modules of a moment are in between, since most of the others wait.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from xdist.scheduler import LoadScopeScheduling

PAGES = "tests/page/"
BROWSERS = 3
"""So many workers have one at most."""
IN_NODE = (
    "tests/page/test_macs_js.py",
    "tests/page/test_xr_command.py",
    "tests/page/test_xr_pure.py",
    "tests/page/test_xr_shown.py",
)
"""Files there whose tests run in node, and share nothing."""

LONG = (
    "tests/conformance/",
    "tests/integration/test_cli_programs.py",
    "tests/integration/test_resume.py",
    "tests/integration/test_security_check.py",
    "tests/integration/test_wheel.py",
    "tests/ros/test_definitions.py",
    "tests/ros/test_graph_verbs.py",
    "tests/ros/test_robot_processes.py",
)
"""Files with tests that take a minute, or half of it."""

ONE_WORKER = ("tests/integration/test_wheel.py",)
"""Files whose tests wait for the same thing to be made: one worker does, and none for another."""

TOGETHER = (
    ("tests/unit/test_errors.py", "tests/unit/test_house.py", "tests/unit/test_imports.py"),
    ("tests/unit/test_counters.py", "tests/unit/test_docs_site.py"),
)
"""Quick files that one worker does after the other: each reads all sources, and finds them read."""

QUICK = "tests/unit/"


def path_of(name: str) -> str:
    """The file that a test is in."""
    return name.partition("::")[0]


def shown(name: str) -> bool:
    """Whether a test looks at a page in a browser."""
    return name.startswith(PAGES) and not name.startswith(IN_NODE)


def page_groups(names: Iterable[str]) -> dict[str, str]:
    """The group of each file with pages: as many groups as there may be browsers, as equal as files allow."""
    counts: dict[str, int] = {}
    for name in names:
        if shown(name):
            counts[path_of(name)] = counts.get(path_of(name), 0) + 1
    sizes = dict.fromkeys(range(BROWSERS), 0)
    groups = {}
    for path, count in sorted(counts.items(), key=lambda each: (-each[1], each[0])):
        group = min(sizes, key=lambda number: (sizes[number], number))
        sizes[group] += count
        groups[path] = f"pages {group}"
    return groups


def scope_of(name: str, groups: Mapping[str, str]) -> str:
    """What a test is handed out with: its group, its file, or nothing but itself."""
    path = path_of(name)
    path = next((group[0] for group in TOGETHER if path in group), path)
    return path if path.startswith((QUICK, *ONE_WORKER)) else groups.get(path, name)


def order(names: Sequence[str]) -> list[int]:
    """In which order they are begun: indices of these."""
    quick = {path: number for number, path in enumerate(dict.fromkeys(map(path_of, names))) if path.startswith(QUICK)}
    first, last = min(quick.values(), default=0), max(quick.values(), default=0)
    others = [name for name in names if not name.startswith(QUICK)]
    places = {name: number / len(others) for number, name in enumerate(others)}

    def place(index: int) -> tuple[int, float]:
        name = names[index]
        if shown(name):
            return 0, 0.0
        if name.startswith(LONG):
            return 1, 0.0
        path = path_of(name)
        return (2, (quick[path] - first) / (last - first + 1) if path in quick else places[name])

    return sorted(range(len(names)), key=place)


class Sharing(LoadScopeScheduling):  # type: ignore[misc]
    """xdist's, which hands out one test after the other, or all of one group."""

    def __init__(self, config: Any, log: Any = None) -> None:
        super().__init__(config, log)
        config.option.loadscopereorder = False  # they come in their order
        self._groups: dict[str, str] = {}

    def schedule(self) -> None:
        if self.collection is None:
            self._groups = page_groups(next(iter(self.registered_collections.values())))
        super().schedule()

    def _split_scope(self, nodeid: str) -> str:
        return scope_of(nodeid, self._groups)
