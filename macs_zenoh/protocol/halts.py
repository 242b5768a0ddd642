"""Which commands say: stand still. Pure.

A command that has waited is not carried out, but who let go of the stick while his network stood still says so once,
and nobody says it again. So a velocity of zero goes on however old it is; what came before it does not. Of other types
nothing is known: zero may be a place to go to.
"""

from __future__ import annotations

import struct

from .offers import short_type
from .wire import Buffer

TWIST, TWIST_STAMPED = "geometry_msgs/Twist", "geometry_msgs/TwistStamped"
HALTS_PER_S = 20
"""So many go on that are more than their sender may send."""

_BEGIN = 4
"""Bytes that say how the data is written, before it."""
_STAMP = 8
_VELOCITY = 6
"""Numbers: along and around three axes."""
_MOST_BYTES = 1024
"""What says it passes limits, so it is small."""


def may_halt(data_type: str) -> bool:
    """Whether a message of this type may say it."""
    return short_type(data_type) in (TWIST, TWIST_STAMPED)


def halts(data_type: str, data: Buffer) -> bool:
    """Whether a command says it; CDR that is cut short or written in another way does not."""
    if not _BEGIN <= len(data) <= _MOST_BYTES or data[0] or data[1] > 1:
        return False
    order = "<" if data[1] else ">"
    kind = short_type(data_type)
    try:
        if kind == TWIST:
            at = _BEGIN
        elif kind == TWIST_STAMPED:
            (name_bytes,) = struct.unpack_from(f"{order}I", data, _BEGIN + _STAMP)
            at = _BEGIN + (_STAMP + 4 + name_bytes + 7) // 8 * 8
        else:
            return False
        return not any(struct.unpack_from(f"{order}{_VELOCITY}d", data, at))
    except struct.error:
        return False
