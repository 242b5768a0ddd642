"""The file of tokens, when it cannot be read, or what reads it fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridge.tokens import store
from bridge.tokens.watch import Watch
from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol.tokens import Tokens
from tests.support.waiting import until


def test_a_file_whose_reading_fails_is_one_that_cannot_be_used() -> None:
    """A disk that fails, or a file system that is gone: it is said in one line, as whatever else is wrong with it."""
    with pytest.raises(ConfigError, match="mem"):
        store.read(Path("/proc/self/mem"))  # a file of one's own, open to nobody else, whose beginning cannot be read


async def test_tokens_end_with_time_whatever_becomes_of_their_file(tmp_path: Path) -> None:
    """Each look is made, also one in which what is read fails."""
    path, looks, fails = tmp_path / "tokens.json", [0], [0]
    path.write_text('{"tokens": []}')
    path.chmod(0o600)

    def look() -> None:
        looks[0] += 1

    def read(_before: Tokens, _now: Tokens) -> None:
        fails[0] += 1
        raise OSError

    watch = Watch(path, look)
    watch.on_read = read
    watch.start()
    try:
        await until(lambda: looks[0])
        path.write_text('{"tokens": [ ]}')
        await until(lambda: fails[0] and looks[0] > fails[0])
    finally:
        watch.close()
