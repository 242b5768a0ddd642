"""How settings name agents: those that may do something, and those that are believed to be in a group. Pure."""

from __future__ import annotations

from macs_zenoh.errors import UsageError
from macs_zenoh.protocol.keyexpr import type_name, type_number

AgentPattern = str
"""``*``, a type of agents, one of them (``unity/5``), a group (``group/3``) or a block of headsets (``block/1``)."""


def names_agents(pattern: str) -> bool:
    """Whether some agent can fit: others are typing errors, which would lock somebody out without a word."""
    kind, slash, number = pattern.partition("/")
    ranges = {"group": (1, 255), "block": (0, 255)}
    if kind not in ranges:
        try:
            known = kind == type_name(type_number(kind))  # 1 is always written ros
        except UsageError:
            known = False
        if not slash or not known:
            return pattern == "*" or known
    low, high = ranges.get(kind, (0, 0xFFFF))
    return number.isascii() and number.isdigit() and str(int(number)) == number and low <= int(number) <= high
