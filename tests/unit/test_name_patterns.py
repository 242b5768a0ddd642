"""Which names a pattern fits."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.name_patterns import matches


@pytest.mark.parametrize(
    ("pattern", "fits", "not_fits"),
    [
        ("/cmd_vel", ["/cmd_vel"], ["/cmd_vel2", "/a/cmd_vel", "/"]),
        ("/camera/*", ["/camera/image"], ["/camera", "/camera/image/compressed", "/camera/_hidden"]),
        ("/camera/**", ["/camera", "/camera/image", "/camera/image/compressed"], ["/cameras", "/camera/_a/b"]),
        ("/**", ["/a", "/a/b/c"], ["/_a", "/a/_b", "/a/_b/c"]),
        ("/**/image_*", ["/image_raw", "/a/b/image_raw"], ["/a/image", "/image_raw/x"]),
        ("/**/_action/**", ["/turn/_action/status"], ["/turn/status"]),
    ],
)
def test_patterns(pattern: str, fits: list[str], not_fits: list[str]) -> None:
    """One star stays in a level, two cross levels, and neither reaches hidden names."""
    assert [name for name in [*fits, *not_fits] if matches(pattern, name)] == fits
