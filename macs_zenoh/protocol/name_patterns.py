"""Which names of topics, services and actions a pattern fits. Pure.

As in a shell, wildcards do not reach what is hidden: a level that begins with ``_``, as ROS hides its own, is matched
only by a pattern that spells the ``_``.
"""

from __future__ import annotations

import fnmatch
from functools import lru_cache
from typing import Annotated

from msgspec import Meta

PATTERN = r"^(/[A-Za-z0-9_*]+)+$"
"""What a pattern of names looks like."""

NamePattern = Annotated[str, Meta(pattern=PATTERN, max_length=256)]
"""A full ROS name in which ``*`` stands for anything within one level and ``**`` for any number of levels."""


@lru_cache(maxsize=4096)
def matches(pattern: str, name: str) -> bool:
    """Whether a full name fits a pattern: ``*`` within one level, ``**`` any number of levels, also none."""
    return _matches(pattern.split("/"), name.split("/"))


def _matches(pattern: list[str], name: list[str]) -> bool:
    if not pattern:
        return not name
    head, rest = pattern[0], pattern[1:]
    if head == "**":
        return _matches(rest, name) or (bool(name) and not name[0].startswith("_") and _matches(pattern, name[1:]))
    if not name or (name[0].startswith("_") and not head.startswith("_")):
        return False
    return fnmatch.fnmatchcase(name[0], head) and _matches(rest, name[1:])
