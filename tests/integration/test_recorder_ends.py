"""A recorder whose programs end: it says which and why, goes on, and begins its ring again."""

from __future__ import annotations

import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason="needs the extra web: pip install 'macs-zenoh[web]'")
pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

import aiohttp

from bridge.recording.serving import server, socket_of
from bridge.recording.serving.children import Child
from bridge.recording.serving.server import Recorder, Service
from tests.support.routers import Router
from tests.support.waiting import until


class Served:
    """A recorder of this process, whose recordings and ring are programs, and what it answers."""

    def __init__(self, recorder: Recorder, session: aiohttp.ClientSession) -> None:
        self.recorder = recorder
        self._session = session

    async def post(self, what: str, body: str = "{}") -> tuple[int, dict[str, Any]]:
        async with self._session.post(f"http://recorder/{what}", data=body) as answer:
            return answer.status, await answer.json()

    async def state(self) -> dict[str, Any]:
        async with self._session.get("http://recorder/state") as answer:
            return dict(await answer.json())


@asynccontextmanager
async def served(folder: Path, *ring: str) -> AsyncIterator[Served]:
    async with Router() as router:
        recorder = Recorder(Service(folder, ("-e", router.endpoint), ring=ring))
        try:
            await recorder.open()
            async with aiohttp.ClientSession(connector=aiohttp.UnixConnector(str(socket_of(folder)))) as session:
                yield Served(recorder, session)
        finally:
            await recorder.close()


async def test_a_recording_that_fails_is_told(tmp_path: Path) -> None:
    """Its program is killed: the state says so, until another is begun."""
    async with served(tmp_path) as site:
        _, begun = await site.post("start")
        assert site.recorder._recording is not None
        site.recorder._recording.signal(signal.SIGKILL)

        async def is_told() -> bool:
            state = await site.state()
            return state["recording"] is None and begun["name"] in state["problem"]

        await until(is_told, every_s=0.1)
        assert "signal 9" in (await site.state())["problem"]
        assert (await site.post("start"))[0] == 200
        assert (await site.state())["problem"] == ""
        assert (await site.post("stop"))[0] == 200
        assert (await site.state())["problem"] == ""


async def test_a_ring_begins_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is said that it is gone, and no ring is written; then there is one again, and nothing to say."""
    monkeypatch.setattr(server, "RING_AGAIN_S", 0.5, raising=False)
    async with served(tmp_path, "--ring", "30s") as site:
        first = site.recorder._ring
        assert first is not None
        first.signal(signal.SIGKILL)

        async def is_told() -> bool:
            return "the ring has ended" in (await site.state())["problem"]

        async def goes_on() -> bool:
            return (await site.state())["problem"] == "" and (await site.post("ring"))[0] == 200

        await until(is_told, every_s=0.05)
        assert (await site.post("ring"))[0] == 409
        await until(goes_on, every_s=0.2)
        assert site.recorder._ring is not first


async def test_one_that_ends_at_once_does_not_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording has ended before it was seen that it was ready: that is said, and the next one begins."""
    ready = Child.ready

    async def late(self: Child) -> None:
        await ready(self)
        self.signal(signal.SIGKILL)
        await self._ended

    async with served(tmp_path) as site:
        with monkeypatch.context() as patched:
            patched.setattr(Child, "ready", late)
            status, told = await site.post("start")
            assert (status, "signal 9" in told["error"]) == (409, True)
            assert (await site.state())["recording"] is None
        assert (await site.post("start"))[0] == 200


async def test_what_has_only_begun_is_not_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording is one when it records: until then the state has none."""
    ready, seen = Child.ready, list[object]()

    async with served(tmp_path) as site:

        async def looked_at(self: Child) -> None:
            seen.append((await site.state())["recording"])
            await ready(self)

        monkeypatch.setattr(Child, "ready", looked_at)
        assert (await site.post("start"))[0] == 200
        assert (await site.state())["recording"] is not None
    assert seen == [None]


async def test_what_is_said_of_the_ring_stays_when_a_recording_begins(tmp_path: Path) -> None:
    """Another's problem is not forgotten."""
    async with served(tmp_path, "--ring", "30s") as site:
        assert site.recorder._ring is not None
        site.recorder._ring.signal(signal.SIGKILL)
        await until(lambda: site.recorder._ring is None)
        keeper = site.recorder._ring_keeper
        assert keeper is not None
        keeper.cancel()  # it would be there again before the recording is
        assert (await site.post("start"))[0] == 200
        assert "the ring has ended" in (await site.state())["problem"]
