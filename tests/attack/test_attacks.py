"""Each attack with which a site was once brought down, or a stop lost, and (marked ``kin``) those of its kind.

Judged roughly: what a busy machine does must not look like a fault, while each of the faults cost seconds. The figures
are printed; `python -m tests.attack` judges them strictly.
"""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
import pytest_asyncio

pytest.importorskip("rclpy", reason="the robot that is driven needs ROS")

from tests.attack import judge, table
from tests.attack.scene import Scene, scene
from tests.attack.ways import Way

SECONDS = 2.0

pytestmark = [pytest.mark.asyncio(loop_scope="module")]


class Stage:
    """One scene for all attacks, and a new one after an attack that has broken it."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._stack = AsyncExitStack()
        self._scene: Scene | None = None
        self._kind: tuple[bool, Way] = (False, "tcp")

    async def scene(self, row: table.Attack) -> Scene:
        """A scene in which everything is as it should be, and of the kind that is wanted."""
        kind = _kind(row)
        if self._scene is not None and self._kind != kind:
            await self.clear()
        if self._scene is None:
            domain, self._kind = 1 + os.getpid() % 100, kind
            made = scene(self._directory, domain, certified=row.certified, way=kind[1])
            self._scene = await self._stack.enter_async_context(made)
        return self._scene

    async def clear(self) -> None:
        """End what runs."""
        self._scene = None
        await self._stack.aclose()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def stage(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Stage]:
    stage = Stage(tmp_path_factory.mktemp("attack"))
    yield stage
    await stage.clear()


def _kind(row: table.Attack) -> tuple[bool, Way]:
    return row.certified, row.way or "tcp"


def rows() -> list[object]:
    """The table, those that are kin marked so."""
    every = sorted(table.every().values(), key=_kind)  # few changes of scene
    return [pytest.param(row, id=row.name, marks=[] if row.seen else [pytest.mark.kin]) for row in every]


@pytest.mark.parametrize("row", rows())
async def test_it_costs_nobody_but_the_attacker(row: table.Attack, stage: Stage) -> None:
    """Neighbours are served, the robot is driven, stops and the dead-man work, and afterwards all is as before."""
    report = None
    try:
        report = await (await stage.scene(row)).suffer(row, seconds=SECONDS)
        print(f"\n{row.says}")
        for heading, figure in zip(judge.HEADINGS, judge.row(report), strict=True):
            print(f"  {heading:18} {figure}")
        assert not report.roughly()
    finally:
        if report is None or report.broken:
            await stage.clear()
