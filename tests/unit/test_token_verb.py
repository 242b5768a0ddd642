"""`macs token`: what it keeps, prints and refuses; and the file that it keeps it in."""

from __future__ import annotations

import json
import os
import stat
import threading
from pathlib import Path

import pytest

from bridge.cli import main
from bridge.tokens import store
from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol.tokens import Token, hash_of


@pytest.fixture(autouse=True)
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where tokens are kept in these tests."""
    path = tmp_path / "site" / "tokens.json"
    monkeypatch.setenv("MACS_TOKENS", str(path))
    return path


@pytest.fixture
def macs(capsys: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    """Runs the verb; its exit code, and what it printed."""

    def run(*words: str) -> tuple[int, str]:
        code = main(["token", *words])
        return code, capsys.readouterr().out.strip()

    return run


def test_a_token_is_printed_once_and_kept_as_a_hash(macs, file: Path) -> None:  # type: ignore[no-untyped-def]
    """What is printed is the token; the file, for its owner alone, has only its hash, and lists show neither."""
    code, secret = macs("create", "anna", "--robots", "1,2", "--groups", "3", "--may", "see,stop", "--expires", "30d")
    assert code == 0
    assert secret.startswith("macs_")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    assert secret not in file.read_text()
    token = store.read(file).named("anna")
    assert token.hashes == [hash_of(secret)]
    assert (token.rights.may, token.rights.robots, token.rights.groups) == (["see", "stop"], [1, 2], [3])
    code, listed = macs("list")
    assert code == 0
    assert listed.startswith("anna  see,stop  robots 1,2  groups 3  topics /**  ends in 30d")
    (shown,) = json.loads(macs("list", "--json")[1])
    assert shown["name"] == "anna"
    assert hash_of(secret) not in listed + json.dumps(shown)
    assert macs("show", "anna")[1] == listed


def test_tokens_change_rotate_and_end(macs, file: Path) -> None:  # type: ignore[no-untyped-def]
    """Other rights under the same secret; another secret under the same rights; nothing any more."""
    _, secret = macs("create", "anna", "--robots", "any")
    assert macs("change", "anna", "--robots", "7", "--may", "see") == (0, "")
    changed = store.read(file).find(secret, 0.0)
    assert changed is not None
    assert changed.rights.robots == [7]
    code, rotated = macs("rotate", "anna")
    assert code == 0
    assert store.read(file).find(secret, 0.0) is None
    assert store.read(file).find(rotated, 0.0) == store.read(file).named("anna")
    assert macs("revoke", "anna") == (0, "")
    assert store.read(file).tokens == []


@pytest.mark.parametrize(
    "words",
    [
        ("create", "anna"),  # there is one
        ("create", "a b"),
        ("create", "../x"),
        ("create", "new", "--robots", "x"),
        ("create", "new", "--robots", "70000"),
        ("create", "new", "--may", "fly"),
        ("create", "new", "--may", "broadcast", "--robots", "1"),
        ("create", "new", "--topics", "camera"),
        ("create", "new", "--expires", "soon"),
        ("revoke", "nobody"),
        ("rotate", "nobody"),
        ("show", "nobody", "--qr"),
        (),
    ],
)
def test_what_cannot_be_is_wrong_usage(macs, file: Path, words: tuple[str, ...]) -> None:  # type: ignore[no-untyped-def]
    """It costs nothing that was there."""
    macs("create", "anna")
    before = file.read_bytes()
    try:
        code, _ = macs(*words)
    except SystemExit as ended:
        code = int(ended.code or 0)
    assert code == 2
    assert file.read_bytes() == before


def test_a_headset_is_paired_by_a_picture(macs, file: Path) -> None:  # type: ignore[no-untyped-def]
    """A code of six digits, and the address of the web port behind a #, which nobody is sent."""
    macs("create", "anna")
    code, shown = macs("show", "anna", "--qr", "--url", "http://10.0.0.1:7080/")
    assert code == 0
    assert "█" in shown or "▀" in shown
    said = json.loads(macs("show", "anna", "--qr", "--url", "http://10.0.0.1:7080/", "--json")[1])
    assert said["url"] == f"http://10.0.0.1:7080/#pair={said['code']}"
    assert len(said["code"]) == 6
    (pairing,) = store.read(file).pairings  # the second in place of the first
    assert said["code"] not in file.read_text()
    assert pairing.name == "anna"


def test_a_file_of_others_is_not_believed(file: Path, tmp_path: Path) -> None:
    """One that others can read or write, a link, a directory, or what is no file of tokens is an error."""
    store.change(file, lambda tokens: (tokens.with_token(Token(name="anna")), None))
    file.chmod(0o640)
    with pytest.raises(ConfigError, match="open to others"):
        store.read(file)
    file.chmod(0o600)
    assert store.read(file).named("anna")
    link = tmp_path / "link"
    link.symlink_to(file)
    with pytest.raises(ConfigError):
        store.read(link)
    with pytest.raises(ConfigError, match="is no file"):
        store.read(tmp_path)
    file.write_text("{")
    with pytest.raises(ConfigError, match="no file of tokens"):
        store.read(file)
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(ConfigError, match="is no file"):
        store.read(tmp_path / "pipe")
    assert store.read(tmp_path / "nothing").tokens == []


def test_many_who_write_at_once_lose_nothing(file: Path) -> None:
    """Each change is made to what the one before has left, and a reader finds a whole file at any time."""
    stop, wrong = threading.Event(), []

    def read() -> None:
        while not stop.is_set():
            try:
                store.read(file)
            except ConfigError as error:
                wrong.append(error)

    def write(first: int) -> None:
        for number in range(first, first + 10):
            store.change(file, lambda tokens: (tokens.with_token(Token(name=f"t{number}")), None))  # noqa: B023

    reader = threading.Thread(target=read)
    reader.start()
    writers = [threading.Thread(target=write, args=(10 * number,)) for number in range(5)]
    for thread in writers:
        thread.start()
    for thread in writers:
        thread.join()
    stop.set()
    reader.join()
    assert wrong == []
    assert len(store.read(file).tokens) == 50
    assert sorted(path.name for path in file.parent.iterdir()) == ["tokens.json", "tokens.json.lock"]
