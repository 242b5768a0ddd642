"""What a headset's scene shows: sizes of pictures, ages of values, whom a button names, what is given back."""

from __future__ import annotations

import pytest

from tests.page.test_macs_js import ran
from tests.support.browser import STATIC, needs_node

THREE = STATIC / "vendor" / "three.js"
needs_three = pytest.mark.skipif(not THREE.is_file(), reason="three.js is missing: make page")


@needs_node
@pytest.mark.parametrize("part", ["sizes", "aged", "named", "pixels", "room"])
def test_what_holds(part: str) -> None:
    """Each check of this part of `xr_shown.mjs`."""
    assert ran("xr_shown.mjs", {"part": part}) == {"held": part}


@needs_node
@needs_three
@pytest.mark.parametrize("part", ["eyes", "bytes", "joined", "map", "told"])
def test_what_is_drawn(part: str) -> None:
    """The same, of parts that draw."""
    assert ran("xr_shown.mjs", {"part": part}) == {"held": part}
