"""A recorder's ring and the folder that it shares: what a page, a stop or a dead-man writes does not fill the disk."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason="needs the extra web: pip install 'macs-zenoh[web]'")
pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

import aiohttp

from bridge.recording.serving import socket_of
from tests.support.programs import Program
from tests.support.routers import Router
from tests.support.waiting import until


class Asked:
    """A recorder, asked as a gateway asks it."""

    def __init__(self, session: aiohttp.ClientSession, folder: Path) -> None:
        self._session = session
        self.folder = folder

    async def post(self, what: str, **said: Any) -> tuple[int, dict[str, Any]]:
        async with self._session.post(f"http://recorder/{what}", data=json.dumps(said)) as answer:
            return answer.status, await answer.json()

    async def state(self) -> dict[str, Any]:
        async with self._session.get("http://recorder/state") as answer:
            return dict(await answer.json())


@asynccontextmanager
async def recorder(tmp_path: Path, settings: str, *words: str) -> AsyncIterator[Asked]:
    folder = tmp_path / "recordings"
    folder.mkdir()
    file = tmp_path / "macs.toml"
    file.write_text(settings)
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Router())
        common = ("--settings", str(file), "-e", router.endpoint)
        await stack.enter_async_context(Program("record", "--serve", str(folder), *words, *common))
        connector = aiohttp.UnixConnector(str(socket_of(folder)))
        yield Asked(await stack.enter_async_context(aiohttp.ClientSession(connector=connector)), folder)


async def test_orders_have_an_end(tmp_path: Path) -> None:
    """A page's order is answered with the file, or why there is none: no more than `ring_files` are written."""
    async with recorder(tmp_path, "[record]\nring_files = 1\nafter_s = 0.2\n", "--ring", "30s") as asked:
        status, told = await asked.post("ring")
        assert status == 200
        assert told["name"].startswith("ring_asked_")
        refused: set[str] = set()

        async def is_refused() -> bool:
            status, told = await asked.post("ring")
            if status == 409:
                refused.add(told["error"])
            return any("ring_files" in why for why in refused)

        await until(is_refused, every_s=0.1)
        assert len(list(asked.folder.glob("ring_*.mcap"))) == 1


async def test_a_full_folder_gets_no_ring(tmp_path: Path) -> None:
    """With as much in the folder as it may have: refused, with the reason, and nothing is written."""
    async with recorder(tmp_path, "[record]\nfolder_bytes = 1048576\n", "--ring", "30s") as asked:
        (asked.folder / "a.mcap").write_bytes(bytes(1 << 20))
        status, told = await asked.post("ring")
        assert status == 409
        assert "folder_bytes" in told["error"]
        assert [path.name for path in asked.folder.glob("*.mcap")] == ["a.mcap"]
        assert (await asked.state())["ring"] is not None
