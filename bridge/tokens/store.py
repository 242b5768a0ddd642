"""The file of tokens on disk: read whole, written whole, by one at a time, and by nobody but its owner."""

from __future__ import annotations

import fcntl
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from macs_zenoh.errors import ConfigError, UsageError
from macs_zenoh.protocol.tokens import Tokens, encode, parse

PRIVATE_DIRECTORY, PRIVATE_FILE = 0o700, 0o600

MOST_BYTES = 4 << 20
"""A thousand tokens have less."""

T = TypeVar("T")


def usual_path() -> Path:
    """Where tokens are kept unless something else is said: ``$MACS_TOKENS``, or in the user's configuration."""
    named = os.environ.get("MACS_TOKENS")
    if named:
        return Path(named)
    base = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(base).expanduser() / "macs" / "tokens.json"


def path_of(said: str | None) -> Path:
    """Where tokens are kept, as a setting or an option says, or does not say."""
    return usual_path() if said is None else Path(said).expanduser()


def read(path: Path) -> Tokens:
    """The tokens in a file; none without a file. Raises ConfigError: it is not ours alone, or no file of tokens."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        return Tokens()
    except OSError as error:
        raise ConfigError(str(path), error.strerror or str(error)) from error
    try:
        _check_own(path, os.fstat(descriptor))
    except BaseException:
        os.close(descriptor)
        raise
    try:
        with os.fdopen(descriptor, "rb") as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:  # of a disk, or of a file system that is not there any more
        raise ConfigError(str(path), error.strerror or str(error)) from error
    if len(content) > MOST_BYTES:
        raise ConfigError(str(path), f"has more than {MOST_BYTES} bytes: it is no file of tokens")
    return parse(content, str(path))


def change(path: Path, edit: Callable[[Tokens], tuple[Tokens, T]]) -> T:
    """Read, change and write the file while nobody else does; returns what ``edit`` gives besides. Nothing is written
    when nothing has changed. Raises ConfigError, UsageError: it cannot be written, and what ``edit`` raises."""
    with _locked(path):
        before = read(path)
        after, result = edit(before)
        if after != before:
            _write(path, encode(after))
    return result


def _check_own(path: Path, found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise ConfigError(str(path), "is no file")
    if found.st_uid not in (os.geteuid(), 0):
        raise ConfigError(str(path), f"belongs to user {found.st_uid}, not to who runs this")
    if found.st_mode & 0o077:
        raise ConfigError(
            str(path), f"is open to others: chmod {PRIVATE_FILE:o} it, or its owner takes the tokens back"
        )


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Alone with the file, by a file beside it: the file itself is another one after each change."""
    beside = path.with_name(path.name + ".lock")
    try:
        path.parent.mkdir(mode=PRIVATE_DIRECTORY, parents=True, exist_ok=True)
        descriptor = os.open(beside, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, PRIVATE_FILE)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _write(path: Path, content: bytes) -> None:
    """Readers find the old content or the new, also after a power cut; with its permissions from the first byte on."""
    beside = None
    try:
        descriptor, beside = tempfile.mkstemp(prefix=path.name + ".", dir=path.parent)  # 0600
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(descriptor)
        Path(beside).replace(path)
    except OSError as error:
        if beside is not None:
            with suppress(OSError):
                Path(beside).unlink()
        raise UsageError(f"{path}: {error.strerror or error}") from error
