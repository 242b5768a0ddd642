"""How many examples a test of any input draws: all of them in ``make test-all`` and CI, a part on the way there."""

from __future__ import annotations

import os

THOROUGH = "MACS_THOROUGH"
"""Set for all."""
PART, FEW = 4, 20


def examples(number: int) -> int:
    """So many as are drawn of ``number``."""
    return number if os.environ.get(THOROUGH) else min(number, max(FEW, number // PART))
