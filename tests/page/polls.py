"""Waiting for what a page shows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.support import waiting
from tests.support.waiting import PATIENCE_S

EVERY_S = 0.03
"""A question to a page goes through four processes and back, which takes more of them than most pages do."""


async def until(condition: Callable[[], Any], timeout_s: float = PATIENCE_S, *, every_s: float = EVERY_S) -> Any:
    """Wait until the condition holds, as `waiting.until` does; what it returned."""
    return await waiting.until(condition, timeout_s, every_s=every_s)
