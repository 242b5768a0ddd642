"""How a headset's commands tell their time, and when they go out at all, without a browser or a network."""

from __future__ import annotations

import pytest

from tests.page.test_macs_js import ran
from tests.support.browser import STATIC, needs_node

PARTS = (
    "asked",
    "left",
    "groups",
    "anew",
    "never_younger",
    "late",
    "stamped",
    "owed",
    "owed_to_a_group",
    "no_router",
    "stood",
    "grouped",
    "too_many",
    "standing",
    "compared",
    "types",
    "poke",
)


LIBRARIES = STATIC / "vendor" / "libraries.js"
NEEDS = pytest.mark.skipif(not LIBRARIES.is_file(), reason="libraries are missing: make page")


@NEEDS
@needs_node
@pytest.mark.parametrize("part", PARTS)
def test_what_holds(part: str) -> None:
    """Each check of this part of `xr_command.mjs`."""
    assert ran("xr_command.mjs", {"part": part}) == {"held": part}
