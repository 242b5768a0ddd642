"""Sizes and times as people write them at a command line: ``500MB``, ``1GiB``, ``90s``, ``10m``."""

from __future__ import annotations

import argparse
import re

from macs_zenoh.protocol.name_patterns import PATTERN

_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kMGT]?)(i?)B?", re.IGNORECASE)
_TIME = re.compile(r"(\d+(?:\.\d+)?)\s*(ms|s|m|min|h|)")
_SECONDS = {"ms": 0.001, "": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


def size(text: str) -> int:
    """Bytes of ``10GB`` (10⁹) or ``10GiB`` (2³⁰). Raises ArgumentTypeError."""
    match = _SIZE.fullmatch(text.strip())
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no size, as in 500MB or 2GiB")
    base = 1024 if match[3] else 1000
    found = float(match[1]) * base ** (" kmgt".index(match[2].lower()) if match[2] else 0)
    if found < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is nothing")
    return int(found)


def seconds(text: str) -> float:
    """Seconds of ``90``, ``90s``, ``10m`` or ``1h``. Raises ArgumentTypeError."""
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no time, as in 90s, 10m or 1h")
    return float(match[1]) * _SECONDS[match[2]]


def pattern(text: str) -> str:
    """A pattern of topics' names: ``/camera/**``. Raises ArgumentTypeError."""
    if re.fullmatch(PATTERN, text) is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no pattern of names, as '/camera/**'")
    return text


def in_bytes(count: float) -> str:
    """``1.2 GB`` of a number of bytes."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def in_time(duration_s: float) -> str:
    """``1:02:03.4`` of a number of seconds."""
    minutes, rest = divmod(duration_s, 60)
    hours, minutes = divmod(int(minutes), 60)
    return f"{hours}:{minutes:02}:{rest:04.1f}"
