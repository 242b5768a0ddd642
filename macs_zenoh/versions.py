"""Which versions of what are installed here."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def installed(package: str) -> str:
    """The version of a Python package, empty when it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
