"""What the scene for headsets decides, without a browser: axes, clutch, age of pictures, gestures, bounds."""

from __future__ import annotations

import pytest

from tests.page.test_macs_js import ran
from tests.support.browser import needs_node

PARTS = (
    "axes",
    "turns",
    "due",
    "hold",
    "freshness",
    "kept",
    "gestures",
    "settings",
    "decode",
    "clock",
    "targets",
    "guards",
    "opened",
    "halt",
    "halt_refused",
    "halt_again",
)


@needs_node
@pytest.mark.parametrize("part", PARTS)
def test_what_holds(part: str) -> None:
    """Each check of this part of `xr_pure.mjs`."""
    assert ran("xr_pure.mjs", {"part": part}) == {"held": part}
