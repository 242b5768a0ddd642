"""What a program that serves does with its memory."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from bridge.cli import running


@pytest.fixture
def thawed() -> Iterator[None]:
    """Nothing is frozen before, and afterwards what a test run has frozen is again."""
    gc.unfreeze()
    yield
    gc.freeze()


def test_who_is_ready_is_not_gone_through_again(thawed: None, capsys: pytest.CaptureFixture[str]) -> None:
    """What a program was built of when it says that it is ready costs the collector nothing from then on."""
    assert not gc.get_freeze_count()
    running.say_ready("somebody")
    assert gc.get_freeze_count() > 1000
    assert capsys.readouterr().out == "ready: somebody\n"
