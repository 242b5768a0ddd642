"""Recordings at a gateway's web port: who may, what there is, downloads; and a recorder that is not there."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason="needs the extra web: pip install 'macs-zenoh[web]'")
pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

import aiohttp
from yarl import URL

from bridge.page.recordings import DOWNLOADS, MISSING
from bridge.recording.bag import Bag
from bridge.recording.disk import Disk, Entry, Plan
from bridge.recording.serving import socket_of
from bridge.recording.streams import REFUSALS, STOPS, Channel
from bridge.tokens import store
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.support.programs import Program, ended, free_port
from tests.support.waiting import until

START = 1_700_000_000_000_000_000


def write(path: Path, size: int = 100) -> None:
    """A recording in which robot 7 was stopped after a second, and refused something after two."""
    disk = Disk(Plan(path, "none"))
    disk.start()
    topic = Channel("/7/chatter", "cdr", "std_msgs/msg/String", "string data", {"robot": "7", "topic": "/chatter"})
    for second in range(4):
        disk.put(Entry(topic, topic.next(size), START + second * 10**9, os.urandom(size)))
    stops, refusals = Channel(STOPS), Channel(REFUSALS)
    stop = {"robot": 7, "stopped": True, "by": "unity/256", "pressed": ["unity/256"], "times": 1, "history": []}
    disk.put(Entry(stops, 1, START + 10**9, json.dumps(stop).encode()))
    refusal = {"from": "ros/7", "to": "unity/256", "robotId": 7, "tosName": "/cmd_vel", "reason": "it is stopped"}
    disk.put(Entry(refusals, 1, START + 2 * 10**9, json.dumps(refusal).encode()))
    disk.put(Entry(refusals, 2, START + 2 * 10**9, b'["no object"]'))
    disk.put(Entry(refusals, 3, START + 2 * 10**9, json.dumps({**refusal, "reason": "\ud800"}).encode()))
    disk.stop()


@dataclass
class Site:
    """A gateway with a recorder, and tokens for two."""

    folder: Path
    url: str
    endpoint: str
    record: str
    see: str
    recorder: Program

    async def get(self, path: str, token: str = "", **headers: str) -> tuple[int, Any]:
        """Status and JSON, or bytes, of an answer."""
        return await self._ask("GET", path, token, headers)

    async def post(self, what: str, token: str = "", **said: Any) -> tuple[int, Any]:
        return await self._ask("POST", f"/recordings/{what}", token, {}, said)

    async def _ask(
        self, method: str, path: str, token: str, headers: dict[str, str], said: Any = None
    ) -> tuple[int, Any]:
        headers = {"Authorization": f"Bearer {token or self.record}", **headers}
        async with (
            aiohttp.ClientSession() as session,
            session.request(method, self.url + path, headers=headers, json=said) as answer,
        ):
            data = await answer.read()
            return answer.status, json.loads(data) if answer.content_type == "application/json" else data

    async def state(self) -> dict[str, Any]:
        status, told = await self.get("/recordings/state")
        assert status == 200
        return dict(told)


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    folder, tokens, settings = tmp_path / "recordings", tmp_path / "tokens.json", tmp_path / "macs.toml"
    folder.mkdir()
    settings.write_text(f'[gateway]\nrecordings = "{folder}"\naudit_file = "{tmp_path / "audit.jsonl"}"\n')
    secrets = {}
    for name, rights in (("desk", Rights(may=["see", "record"], robots="any")), ("wall", Rights(may=["see"]))):
        secrets[name] = new_secret(os.urandom(32))
        token = Token(name=name, rights=rights, hashes=[hash_of(secrets[name])])
        store.change(tokens, lambda known, token=token: (known.with_token(token), None))
    endpoint, web = f"tcp/127.0.0.1:{free_port()}", free_port()
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(Program("router", "-l", endpoint))
        words = ["--port", "0", "--web-port", str(web), "--tokens", str(tokens), "--without-token", "nobody"]
        await stack.enter_async_context(Program("gateway", "--settings", str(settings), *words, "-e", endpoint))
        recorder = await stack.enter_async_context(Program("record", "--serve", str(folder), "-e", endpoint))
        yield Site(folder, f"http://127.0.0.1:{web}", endpoint, secrets["desk"], secrets["wall"], recorder)


async def test_only_who_has_the_right(site: Site, tmp_path: Path) -> None:
    """A token without it is refused each request, and nothing is begun; without a token likewise; both are noted."""
    write(site.folder / "a.mcap")
    for path in ("/recordings/state", "/recordings/files/a.mcap", "/recordings/happened/a.mcap"):
        assert await site.get(path, site.see) == (403, {"error": MISSING})
        assert (await site.get(path, "macs_wrong"))[0] == 401
    for what in ("start", "stop", "ring", "replay", "replay-stop"):
        assert await site.post(what, site.see) == (403, {"error": MISSING})
    assert (await site.state())["recording"] is None
    assert '"token":"wall"' in (tmp_path / "audit.jsonl").read_text().replace(" ", "")
    for token, may in ((site.see, False), (site.record, True)):
        assert (await site.get("/view/me", token))[1]["recordings"] is may


async def test_a_page_from_elsewhere_begins_nothing(site: Site) -> None:
    """With the cookie of who may, but from another origin: refused before anything is asked."""
    status, _ = await site._ask(
        "POST", "/recordings/start", "", {"Origin": "http://evil.example", "Cookie": f"macs_token={site.record}"}, {}
    )
    assert status == 403
    assert (await site.state())["recording"] is None


async def test_record_list_and_download(site: Site, tmp_path: Path) -> None:
    """Started and stopped from the port: the file is in the list, whole, and what is downloaded is the file. The
    record has who did each of it."""
    status, begun = await site.post("start", commands=True, topics=["/chatter"])
    assert status == 200
    status, again = await site.post("start")
    assert status == 409
    assert begun["name"] in again["error"]

    async def goes_on() -> bool:
        recording = (await site.state())["recording"]
        return recording is not None and recording.get("messages", 0) > 0

    await until(goes_on, every_s=0.1)
    (file,) = (await site.state())["files"]
    assert (file["name"], file["state"]) == (begun["name"], "recording")
    assert await site.post("stop") == (200, {"name": begun["name"]})
    assert (await site.post("stop"))[0] == 409
    (file,) = (await site.state())["files"]
    assert (file["state"], file["lost"]) == ("whole", {})
    status, data = await site.get(f"/recordings/files/{begun['name']}")
    assert status == 200
    assert data == (site.folder / begun["name"]).read_bytes()
    with Bag(site.folder / begun["name"]) as bag:
        about = dict(bag.metadata())["macs.recording"]
    assert (about["topics"], about["commands"]) == ("/chatter", "true")

    def noted() -> list[tuple[str, str]]:
        lines = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
        assert {line["by"]["token"] for line in lines if line["event"] == "recording"} <= {"desk"}
        return [(line["what"], line["result"]) for line in lines if line["event"] == "recording"]

    done = [("start", "done"), ("stop", "done"), (f"download {begun['name']}", "done")]
    await until(lambda: [each for each in noted() if each[1] == "done"] == done)


async def test_what_happened(site: Site) -> None:
    """Stops and refusals by their time; what is no object of ours, or no text, is left out. The verb says the same."""
    write(site.folder / "a.mcap")
    status, told = await site.get("/recordings/happened/a.mcap")
    assert status == 200
    found = [(each["at_s"], each["kind"], each["robot"], each["text"]) for each in told["happened"]]
    assert found == [
        (1.0, "stop", 7, "stopped by unity/256"),
        (2.0, "refusal", 7, "refused unity/256 on /cmd_vel: it is stopped"),
    ]
    code, out, errors = await ended("bag", "events", str(site.folder / "a.mcap"))
    assert code == 0, errors
    assert [" ".join(line.split()) for line in out.splitlines()] == [
        "0:00:01.0 stop robot 7: stopped by unity/256",
        "0:00:02.0 refusal robot 7: refused unity/256 on /cmd_vel: it is stopped",
    ]


@pytest.mark.parametrize(
    "name",
    [
        "..%2Fsecret.mcap",
        "%2e%2e%2fsecret.mcap",
        "..%5csecret.mcap",
        "link.mcap",
        "folder.mcap",
        "a.txt",
        "b.mcap",
        ".hidden.mcap",
        "a.mcap%00",
        "%2Fetc%2Fpasswd",
        f"{'a' * 300}.mcap",
    ],
)
async def test_nothing_but_recordings_is_given(site: Site, name: str, tmp_path: Path) -> None:
    """A path out of the folder, a link that leads elsewhere, a folder, another kind of file, none at all."""
    write(tmp_path / "secret.mcap")
    write(site.folder / ".hidden.mcap")
    (site.folder / "link.mcap").symlink_to(tmp_path / "secret.mcap")
    (site.folder / "folder.mcap").mkdir()
    (site.folder / "a.txt").write_text("no")
    for what in ("files", "happened"):
        path = str(URL(f"/recordings/{what}/{name}", encoded=True))
        async with (
            aiohttp.ClientSession() as session,
            session.get(URL(site.url + path, encoded=True), headers={"Authorization": f"Bearer {site.record}"}) as got,
        ):
            assert got.status in (400, 404), await got.read()
    assert (await site.state())["files"] == []
    assert (await site.post("replay", name=name))[0] == 409


async def test_a_download_can_be_continued_and_is_bounded(site: Site) -> None:
    """A part of a file by its range; and no more downloads at one time than there may be, which end when who
    downloads has gone."""
    write(site.folder / "a.mcap", size=20_000_000)
    whole = (site.folder / "a.mcap").read_bytes()
    status, part = await site.get("/recordings/files/a.mcap", Range=f"bytes={len(whole) - 1000}-")
    assert (status, part) == (206, whole[-1000:])
    async with aiohttp.ClientSession(headers={"Authorization": f"Bearer {site.record}"}) as session:
        open_ones = [await session.get(f"{site.url}/recordings/files/a.mcap") for _ in range(DOWNLOADS)]
        assert [answer.status for answer in open_ones] == [200] * DOWNLOADS
        assert (await site.get("/recordings/files/a.mcap"))[0] == 503
        for answer in open_ones:
            answer.close()

    async def room() -> bool:
        return (await site.get("/recordings/files/a.mcap", Range="bytes=0-99"))[0] == 206

    await until(room, every_s=0.1)


async def test_what_makes_no_sense_is_refused(site: Site) -> None:
    """Unknown words, wrong kinds, too much: an answer says why, and the recorder goes on."""
    for said in ({"folder": "/"}, {"robots": ["--output"]}, {"topics": ["-o/etc/x"]}, {"seconds": -1}):
        status, told = await site.post("start", **said)
        assert status == 400, told
    assert (await site.post("start", topics=["/x" * 3000]))[0] == 413
    status, told = await site.post("replay", name="a.mcap", start_s=0)
    assert (status, told) == (409, {"error": "there is no recording called 'a.mcap'"})
    assert (await site.state())["recording"] is None
    assert (await site.post("ring"))[1]["error"].startswith("this recorder has no ring")


async def test_a_recorder_that_is_away_is_said(site: Site) -> None:
    """The state says so without an error of HTTP; when the recorder is back it is asked again. A second one for the
    folder does not begin."""
    code, _, errors = await ended("record", "--serve", str(site.folder), "-e", site.endpoint)
    assert code == 2
    assert "has a recorder already" in errors
    await site.recorder.stop(signal.SIGKILL)  # its socket stays
    assert "macs record --serve" in (await site.state())["error"]
    await site.recorder.start()
    assert (await site.state())["files"] == []


async def test_a_recording_ends_whole_with_its_recorder(site: Site) -> None:
    """The recorder is told to end while it records: the file has its index."""
    _, begun = await site.post("start")
    await asyncio.wait_for(site.recorder.stop(), 20)
    with Bag(site.folder / begun["name"]) as bag:
        assert bag.messages_in_all > 0


async def test_a_full_folder_begins_none(tmp_path: Path) -> None:
    """With as much in it as it may have: refused, with the reason."""
    settings = tmp_path / "macs.toml"
    settings.write_text("[record]\nfolder_bytes = 1048576\n")
    write(tmp_path / "a.mcap", size=300_000)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    words = ("--settings", str(settings), "-e", endpoint)
    async with (
        Program("router", "-l", endpoint),
        Program("record", "--serve", str(tmp_path), *words),
        aiohttp.ClientSession(connector=aiohttp.UnixConnector(str(socket_of(tmp_path)))) as session,
        session.post("http://recorder/start") as answer,
    ):
        assert answer.status == 409
        assert "folder_bytes" in (await answer.json())["error"]
        assert (socket_of(tmp_path).stat().st_mode & 0o777) == 0o600
