"""How much a test of any input tries: all of it in ``make test-all`` and CI, a part on the way there."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TypeVar

THOROUGH = "MACS_THOROUGH"
"""Set for all."""
PART, FEW = 4, 20

T = TypeVar("T")


def examples(number: int) -> int:
    """So many as are drawn of ``number``."""
    return number if os.environ.get(THOROUGH) else min(number, max(FEW, number // PART))


def some(cases: Sequence[T]) -> Sequence[T]:
    """Those that are tried of a long list of the same kind."""
    return cases if os.environ.get(THOROUGH) else cases[::PART]
