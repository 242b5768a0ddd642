"""How much of a robot's topic has come, beside how much the robot has put: what is missing was lost before. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from macs_zenoh.protocol.robot_state import StreamCount


@dataclass
class Arrived:
    """One topic of one robot.

    Attributes:
        lost: messages that were put for this recording and have not come.
        told: what the robot has told last.
    """

    lost: int = 0
    told: StreamCount | None = None
    _came: int = 0
    _base: int = 0
    """What was put when the robot began to count anew, and how much had come, in one."""

    def message(self) -> None:
        """One has come."""
        self._came += 1

    def count(self, told: StreamCount) -> int:
        """The robot has told, behind all that it counts: how much more is known to be lost.

        Where this recording was registered anew, as after the robot's restart, nobody knows which of the messages
        before this were counted: none of them is taken for lost.
        """
        if self.told is not None and told.since != self.told.since:
            self._base = told.put - self._came - self.lost
        self.told = told
        lost = max(self.lost, told.put - self._came - self._base)
        more, self.lost = lost - self.lost, lost
        return more
