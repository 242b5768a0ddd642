"""What a headset has to know to go on over another connection as the same agent (docs/protocol.md).

Its gateway says how many of the session's frames have come, and what came after them is said again: as far as somebody
still means it. A command is never said again, since by then it would be an old one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from macs_zenoh.protocol.kept import Kept

KEPT_BYTES, KEPT_FRAMES = 1 << 20, 4096
ACK_S = 1.0
"""So often the gateway is told what has come, so that it need not keep it."""

StillMeant = Callable[[], bool]
"""Whether a frame that was lost should be said again, asked when it would be."""


def always() -> bool:
    """Whatever has happened meanwhile."""
    return True


class Frame(NamedTuple):
    """What was said."""

    data: bytes
    still_meant: StillMeant


class Session:
    """One session of a headset, over one connection or several. ``received`` counts the messages on them, without
    those about the connection: the gateway's first one, and the one that says what has become of the session."""

    def __init__(self, secret: str = "") -> None:
        self.secret = secret
        """Empty as long as the gateway has not told one: some do not know sessions."""
        self.received = 0
        self.told = 0
        """How many of these the gateway knows of."""
        self._kept: Kept[Frame] = Kept(KEPT_BYTES, KEPT_FRAMES)
        self._untold: list[Callable[[int], bytes]] = []

    def say(self, frame: bytes, still_meant: StillMeant | None) -> None:
        """A frame goes out now; None: not to be said again."""
        if still_meant is None:
            self._kept.skip()
        else:
            self._kept.put(Frame(frame, still_meant), len(frame))

    def say_later(self, frame: Callable[[int], bytes]) -> None:
        """There is no connection now: say it when there is one again."""
        self._untold.append(frame)

    def arrived(self, frames: int) -> None:
        """So many frames are known to have come."""
        self._kept.arrived(frames)

    def resumed(self, frames: int, own_id: int) -> list[Frame]:
        """It goes on, and so many frames had come: what is to be said now."""
        again, _ = self._kept.again(frames)
        untold, self._untold = self._untold, []
        return [
            *(frame for frame in again if frame.still_meant()),
            *(Frame(frame(own_id), always) for frame in untold),
        ]
