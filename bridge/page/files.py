"""The files of the page, out of the package, read once. What comes from npm `bridge.page.libraries` puts there."""

from __future__ import annotations

import functools
import gzip
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).parent / "static"
LIBRARIES = ("vendor/libraries.js", "vendor/uplot.css")
"""Made of what npm brings; without them there is no page."""
XR_LIBRARIES = ("vendor/libraries.js", "vendor/three.js")
"""Without these there is no scene for headsets."""

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}
COMPRESSED_BYTES = 1024
"""Smaller files are sent as they are."""

WITHOUT_LIBRARIES = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>macs</title></head>
<body><p>The page's libraries are not here. Run <code>make page</code> in the checkout (or
<code>python -m bridge.page.libraries</code>), which fetches them from npm once, and start the gateway
again.</p></body></html>
"""


class File(NamedTuple):
    """One file as it is sent."""

    content_type: str
    body: bytes
    compressed: bytes
    """By gzip; empty where that gains nothing."""
    tag: str
    """Another one for other bytes."""


def read_all() -> dict[str, File]:
    """All files by their path below the page."""
    places = sorted(place for place in FOLDER.rglob("*") if place.suffix in TYPES)
    return {
        name: _file(name, place.read_bytes()) for place in places for name in [place.relative_to(FOLDER).as_posix()]
    }


def missing(found: dict[str, File], libraries: Sequence[str] = LIBRARIES) -> bool:
    """Whether some of these libraries are not there."""
    return any(name not in found for name in libraries)


def without_libraries() -> File:
    """The page that says what to do where they are missing."""
    return _file("index.html", WITHOUT_LIBRARIES.encode())


@functools.cache
def _file(name: str, body: bytes) -> File:
    compressed = gzip.compress(body, 9, mtime=0) if len(body) > COMPRESSED_BYTES else b""
    tag = f'"{hashlib.blake2b(body, digest_size=12).hexdigest()}"'
    return File(TYPES[Path(name).suffix], body, compressed if len(compressed) < len(body) else b"", tag)
