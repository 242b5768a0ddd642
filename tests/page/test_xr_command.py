"""How a headset's commands tell their time, and when they go out at all, without a browser or a network."""

from __future__ import annotations

import pytest

from tests.page.test_macs_js import ran
from tests.support.browser import needs_node

PARTS = ("asked", "left", "groups", "anew", "never_younger")


@needs_node
@pytest.mark.parametrize("part", PARTS)
def test_what_holds(part: str) -> None:
    """Each check of this part of `xr_command.mjs`."""
    assert ran("xr_command.mjs", {"part": part}) == {"held": part}
