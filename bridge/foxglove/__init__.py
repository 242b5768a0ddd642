"""The mesh, live in Foxglove: ``live`` is what its server shows, ``publishing`` what its clients publish, ``relay``
the door before it: whose page asks, by which token.

The server is Foxglove's own SDK (extra ``foxglove``), which gets bytes as they come and decodes nothing.
"""

from __future__ import annotations

import importlib.util

from macs_zenoh.errors import MissingExtra


def need_foxglove() -> None:
    """Raise MissingExtra where the SDK is not installed."""
    if importlib.util.find_spec("foxglove") is None:
        raise MissingExtra("Foxglove", "foxglove-sdk", "foxglove")
