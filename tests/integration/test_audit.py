"""The record of real programs: full disks, kills, new files, several writers, and what verify makes of each."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from bridge.audit import AuditFile, who
from bridge.audit.notes import Shares
from bridge.audit.writer import WAITING, older_files
from bridge.headset.client import Headset
from macs_zenoh.errors import ConfigError, MacsError
from tests.support.processes import finished
from tests.support.programs import ROOT, Program, ended, free_port
from tests.support.waiting import until


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for file in (*older_files(path), path) for line in file.read_bytes().splitlines()]


async def verified(path: Path, *more: str) -> tuple[int | None, dict[str, Any]]:
    code, out, errors = await ended("audit", "verify", str(path), "--json", *more)
    assert out, errors
    return code, json.loads(out)


def kinds(told: dict[str, Any]) -> list[str]:
    return [finding["kind"] for finding in told["findings"]]


@pytest.fixture
async def gateway(tmp_path: Path) -> AsyncIterator[tuple[Program, Path]]:
    """A gateway in a process of its own that keeps a record."""
    endpoint, path = f"tcp/127.0.0.1:{free_port()}", tmp_path / "audit.jsonl"
    settings = tmp_path / "macs.toml"
    settings.write_text(f'[gateway]\naudit_file = "{path}"\n')
    command = ("gateway", "--settings", str(settings), "--port", "0", "-e", endpoint)
    async with Program("router", "-l", endpoint), Program(*command) as one:
        yield one, path


async def test_a_gateway_keeps_a_record(gateway: tuple[Program, Path]) -> None:
    """Who joins, registers and leaves is in it with address and id; it verifies, and changed it does not."""
    one, path = gateway
    async with await Headset.connect("127.0.0.1", one.port, group=3) as headset:
        await headset.subscribe("/chatter", "std_msgs/String", agents=[1])
        await headset.online()
        agent = f"unity/{headset.id}"
    await until(lambda: any(line["event"] == "left" for line in lines_of(path)))
    assert await one.stop() == 0
    told = [(line["event"], line["by"].get("agent"), line["what"]) for line in lines_of(path)]
    assert told[0][0] == "started"
    assert told[1:] == [
        ("joined", agent, "group 3"),
        ("register", agent, "type 1 /chatter at robot 1"),
        ("left", agent, ""),
        ("stopped", None, ""),
    ]
    assert lines_of(path)[1]["by"]["address"].startswith("127.0.0.1:")
    code, said = await verified(path)
    assert (code, kinds(said), said["lines"]) == (0, [], 5)
    path.write_bytes(path.read_bytes().replace(b"/chatter", b"/chatted"))
    code, said = await verified(path)
    assert (code, kinds(said)) == (1, ["changed"])


async def test_a_killed_gateway_goes_on_with_its_chain(gateway: tuple[Program, Path]) -> None:
    """Killed in the middle of a line and started again it continues, and verify tells of both."""
    one, path = gateway
    async with await Headset.connect("127.0.0.1", one.port):
        await until(lambda: any(line["event"] == "joined" for line in lines_of(path)))
        one.send_signal(signal.SIGKILL)
        await one.wait()
    with path.open("ab") as file:
        file.write(b'{"n":2,"time":"20')
    async with Program(*one.argv):
        pass
    code, said = await verified(path)
    assert code == 0, said
    assert [kind for kind in kinds(said) if kind != "open_end"] == ["torn", "killed"]


async def test_tokens_are_in_the_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Made, changed and revoked, by name; who is connected with one when that happens; and who comes without one."""
    endpoint, path, tokens = f"tcp/127.0.0.1:{free_port()}", tmp_path / "audit.jsonl", tmp_path / "tokens.json"
    monkeypatch.setenv("MACS_TOKENS", str(tokens))
    settings = tmp_path / "macs.toml"
    settings.write_text(f'[gateway]\naudit_file = "{path}"\nplain_without_token = "nobody"\n')
    command = ("gateway", "--settings", str(settings), "--port", "0", "-e", endpoint)

    def events() -> list[tuple[str, str | None]]:
        return [(line["event"], line["by"].get("token")) for line in lines_of(path)]

    async with Program("router", "-l", endpoint), Program(*command) as one:
        with pytest.raises(MacsError):
            async with await Headset.connect("127.0.0.1", one.port) as stranger:
                await stranger.online()
        code, shown, errors = await ended("token", "create", "anna", "--may", "see,call")
        assert code == 0, errors
        async with await Headset.connect("127.0.0.1", one.port, token=shown.split()[0]) as headset:
            await headset.online()
            for argv in (["change", "anna", "--may", "see"], ["revoke", "anna"]):
                code, _, errors = await ended("token", *argv)
                assert code == 0, errors
                await until(lambda word=argv[0][:6]: any(word in event or "ended" in event for event, _ in events()))
        await until(lambda: ("left", "anna") in events())
    assert ("refused", None) in events()
    told = [each for each in events() if each[1] == "anna"]
    assert told[:2] == [("token_created", "anna"), ("joined", "anna")]
    assert sorted(told[2:]) == sorted(
        (event, "anna") for event in ("token_changed", "rights_changed", "token_removed", "token_ended", "left")
    )


WRITER = """
import sys, time
from pathlib import Path
from bridge.audit import AuditFile, who
audit = AuditFile(Path(sys.argv[1]), sys.argv[2], max_bytes=int(sys.argv[3]), keep=1000)
print("ready", flush=True)
for number in range(int(sys.argv[4])):
    audit.record("joined", who(f"unity/{number}"), "x" * 100)
    if number % 50 == 0:
        time.sleep(0.001)
audit.close()
"""


def writer(path: Path, name: str, max_bytes: int, count: int) -> subprocess.Popen[str]:
    argv = [sys.executable, "-c", WRITER, str(path), name, str(max_bytes), str(count)]
    process = subprocess.Popen(argv, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def written(path: Path) -> tuple[int, int]:
    """How much is in the newest file, and how many there are before it. There is none while one takes its place."""
    with suppress(FileNotFoundError):
        return path.stat().st_size, len(older_files(path))
    return 0, len(older_files(path))


async def test_kills_while_writing(tmp_path: Path) -> None:
    """Killed again and again while it writes and begins new files, no line is wrong, and none is there twice."""
    path = tmp_path / "audit.jsonl"
    for round_ in range(6):
        process = writer(path, "p", 50_000, 1_000_000)
        before = written(path)
        await until(lambda before=before: written(path) != before)
        await asyncio.sleep(0.05 * round_)
        process.kill()
        process.wait()
    writer(path, "p", 50_000, 10).wait()
    code, said = await verified(path)
    assert code == 0, said["findings"][:5]
    assert kinds(said).count("killed") == 6
    assert set(kinds(said)) <= {"killed", "torn"}
    assert len(older_files(path)) > 1


async def test_several_programs_write_one_record(tmp_path: Path) -> None:
    """Three processes that begin new files meanwhile: each line is there, and the chain is one."""
    path = tmp_path / "audit.jsonl"
    processes = [writer(path, f"p{number}", 20_000, 500) for number in range(3)]
    for process in processes:
        assert process.wait() == 0
    code, said = await verified(path)
    assert code == 0, said["findings"][:5]
    assert (said["lines"], kinds(said)) == (3 * 502, [])
    assert {line["program"] for line in lines_of(path)} == {"p0", "p1", "p2"}


@pytest.mark.parametrize("meanwhile", [1, 40])
async def test_who_begins_a_file_goes_on_from_what_others_wrote_in_it(tmp_path: Path, meanwhile: int) -> None:
    """Another program has waited for the old file: it is the first to write in the new one, and may fill that."""
    path, begun = tmp_path / "audit.jsonl", 0
    one, other = (AuditFile(path, program, max_bytes=4096) for program in ("one", "other"))
    begin = one._open

    def begin_late() -> None:
        nonlocal begun
        begin()
        begun += 1
        if begun == 1:
            for number in range(meanwhile):
                other.record("joined", who(f"unity/{number}"), "x" * 100)
            while other._notes:
                time.sleep(0.001)

    one._open = begin_late  # type: ignore[method-assign]
    for number in range(60):
        one.record("joined", who(f"unity/{number}"), "y" * 100)
    await until(lambda: not one._notes and not other._notes)
    one.close()
    other.close()
    assert begun
    code, said = await verified(path)
    assert (code, said["lines"]) == (0, 60 + meanwhile + 4), said["findings"][:5]


async def test_only_so_many_files_are_kept(tmp_path: Path) -> None:
    """The oldest are removed, the newest stay."""
    path = tmp_path / "audit.jsonl"
    audit = AuditFile(path, "p", max_bytes=4096, keep=2)
    for number in range(200):
        audit.record("joined", who(f"unity/{number}"), "y" * 100)
        await until(lambda: not audit._notes)
    audit.close()
    assert len(older_files(path)) == 2
    numbers = [line["n"] for line in lines_of(path)]
    assert numbers == list(range(numbers[0], 202))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 128 KiB."""
    folder = tmp_path / "small"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=128k", "none", str(folder)]
    if os.geteuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs root, to mount a small file system")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


async def test_a_full_disk(small_disk: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Notes are taken at once all the same; they wait, then are lost and counted; with room again all is told, and how
    much of somebody's was left out before his line was lost."""
    path, lost, busy = small_disk / "audit.jsonl", [0], who("unity/0")
    left_out = 0

    def count(name: str) -> None:
        nonlocal left_out
        lost[0] += name == "audit_lost"
        left_out += name == "audit_left_out"

    audit = AuditFile(path, "p", on_lost=count)
    (small_disk / "filler").write_bytes(bytes(100 << 10))
    while left_out < 10:
        audit.record("register", busy, "z" * 50)
    for number in range(WAITING + 2000):
        audit.record("joined", who(f"unity/{1 + number % 1000}"), "z" * 50)
        if number == 500:
            await until(lambda: "audit_waiting" in audit.troubles())
    assert lost[0] > 0
    await asyncio.sleep(2 / Shares.PER_S)  # then he would have a line, were there room
    audit.record("register", busy)
    assert left_out == 10
    assert path.read_bytes().endswith(b"\n")  # nothing half is left
    assert [record.levelname for record in caplog.records if record.name == "macs.audit"] == ["ERROR"]
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    await until(lambda: not audit._notes)
    audit.record("left", busy)
    audit.close()
    code, said = await verified(path)
    assert (code, kinds(said)) == (0, ["lost"])
    assert [line["lost"] for line in lines_of(path) if "lost" in line] == lost
    assert [line["left_out"] for line in lines_of(path) if "left_out" in line] == [left_out]
    assert lines_of(path)[-1]["event"] == "stopped"
    assert audit.troubles() == {}


async def test_a_gateway_on_a_full_disk(small_disk: Path, tmp_path: Path) -> None:
    """Headsets join and reach each other as ever, and the gateway says so to `macs doctor`, too."""
    endpoint, path = f"tcp/127.0.0.1:{free_port()}", small_disk / "audit.jsonl"
    settings = tmp_path / "macs.toml"
    settings.write_text(f'[gateway]\naudit_file = "{path}"\n')
    command = ("gateway", "--settings", str(settings), "--port", "0", "-e", endpoint)
    async with Program("router", "-l", endpoint), Program(*command) as one:
        (small_disk / "filler").write_bytes(bytes(120 << 10))
        async with await Headset.connect("127.0.0.1", one.port) as headset:
            for _ in range(100):
                await headset.subscribe("/chatter", "std_msgs/String", agents=[1])
                headset.forget(headset.nodes[0])
            await headset.online()
            await until(lambda: any("cannot be written" in line for line in one.log))
            _, out, _ = await ended("doctor", "-e", endpoint, "--json")
            assert "audit_waiting" in out


async def test_what_is_no_record_is_left_alone(tmp_path: Path) -> None:
    """A file with something else in it is refused, not written to; so is a folder that is not there."""
    other = tmp_path / "notes.txt"
    other.write_text("my notes\n")
    os.mkfifo(fifo := tmp_path / "fifo")
    (nothing := tmp_path / "nothing").symlink_to("/dev/null")  # where it would be lost without a word
    for path in (other, tmp_path / "nowhere" / "audit.jsonl", fifo, nothing, tmp_path):
        with pytest.raises(ConfigError):
            AuditFile(path, "p")
    assert other.read_text() == "my notes\n"
    code, _, errors = await ended("audit", "verify", str(fifo))
    assert (code, "is no file" in errors) == (2, True)


async def test_a_record_is_verified_through_a_pipe(tmp_path: Path) -> None:
    """As a shell gives it: by a file descriptor, or as standard input."""
    path = tmp_path / "audit.jsonl"
    AuditFile(path, "p").close()
    macs = f"{sys.executable} -m bridge audit verify"
    for words in (f"{macs} <(cat {path})", f"cat {path} | {macs} /dev/stdin", f"cat {path} | {macs} /proc/self/fd/0"):
        code, out, errors = await finished("bash", "-c", words)
        assert (code, "2 lines, the last is number 1" in out) == (0, True), (words, errors)


async def test_who_does_the_same_all_day_pushes_nothing_out(tmp_path: Path) -> None:
    """What others did stays, and so does what is done with the emergency stop; it is told how much was left out."""
    path, left_out = tmp_path / "audit.jsonl", [0]

    def count(name: str) -> None:
        left_out[0] += name == "audit_left_out"

    audit = AuditFile(path, "p", max_bytes=64 << 10, keep=30, on_lost=count)
    audit.record("joined", who("unity/1", "10.0.0.1:40000"))
    for number in range(40_000):
        audit.record("refused", who(address=f"10.0.0.9:{number}"), "address_not_allowed", "it is not in gateway.allow")
        if number % 100 == 0:
            await asyncio.sleep(0)
    audit.record("stop", who("unity/2", "10.0.0.9:40001"), "/emergency_stop")
    await until(lambda: not audit._notes)
    audit.close()
    lines = lines_of(path)
    assert [line["event"] for line in lines if line["event"] != "refused"] == ["started", "joined", "stop", "stopped"]
    refused = sum(line["event"] == "refused" for line in lines)
    assert refused + left_out[0] == 40_000
    assert refused < 2 * Shares.AT_ONCE
    assert (await verified(path))[0] == 0


async def test_each_kind_of_tampering(tmp_path: Path) -> None:
    """Over several files: changed, removed, reordered, a whole file removed, cut off at the end."""
    path = tmp_path / "audit.jsonl"
    writer(path, "p", 4096, 100).wait()
    files = {file: file.read_bytes() for file in (*older_files(path), path)}
    assert len(files) > 3
    middle = list(files)[1]
    _, head, _ = await ended("audit", "head", str(path))
    lines = files[middle].splitlines(keepends=True)
    tampered: list[tuple[str, Path, bytes | None]] = [
        ("changed", middle, files[middle].replace(b"unity/", b"unitx/", 1)),
        ("removed", middle, b"".join(lines[:1] + lines[2:])),
        ("out_of_order", middle, b"".join([lines[1], lines[0], *lines[2:]])),
        ("removed", middle, None),
        ("cut_off", path, b"".join(files[path].splitlines(keepends=True)[:-1])),
    ]
    for kind, file, data in tampered:
        if data is None:
            file.unlink()
        else:
            file.write_bytes(data)
        code, said = await verified(path, "--seen", head.strip())
        assert (code, kind in kinds(said)) == (1, True), (kind, said)
        file.write_bytes(files[file])
    code, said = await verified(path, "--seen", head.strip())
    assert (code, kinds(said)) == (0, [])


async def test_a_file_that_is_cut_under_a_running_program(tmp_path: Path) -> None:
    """It goes on with its own numbers: what is missing is found."""
    path = tmp_path / "audit.jsonl"
    audit = AuditFile(path, "p")
    for number in range(10):
        audit.record("joined", who(f"unity/{number}"))
    await until(lambda: path.read_bytes().count(b"\n") == 11)
    os.truncate(path, path.read_bytes().index(b"\n") + 1)
    audit.record("left", who("unity/1"))
    audit.close()
    code, said = await verified(path)
    assert (code, kinds(said)) == (1, ["removed"])
