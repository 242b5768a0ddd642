"""Which versions of what are installed here."""

from __future__ import annotations

import functools


@functools.cache
def installed(package: str) -> str:
    """The version of a Python package, empty when it is not installed."""
    from importlib.metadata import PackageNotFoundError, version  # a third of what help takes otherwise

    try:
        return version(package)
    except PackageNotFoundError:
        return ""
