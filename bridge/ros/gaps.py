"""How many messages of a topic ROS has thrown away. Pure."""

from __future__ import annotations


class Gaps:
    """Counts what is missing between messages, by the numbers that their publisher gives them. Pure.

    A subscription keeps the last ``depth`` messages, and ROS counts none that it throws away for newer ones, whether
    they are reliable or not. While there are several publishers the numbers say nothing: each has its own, and rclpy
    does not tell whose a message is.
    """

    SETTLE_S = 0.2
    """How long a gap waits to be told: one between two publishers' numbers comes before ROS tells of the change."""

    def __init__(self) -> None:
        self._publishers = 0
        self._last: int | None = None
        self._missing = 0

    @property
    def counting(self) -> bool:
        """Whether the numbers say anything now."""
        return self._publishers == 1 and self._last is not None

    def publishers(self, count: int) -> None:
        """There are so many now; numbers from before mean nothing any more."""
        self._publishers, self._last, self._missing = count, None, 0

    def take(self, number: int | None) -> bool:
        """A message came, None without a number. True for the first that shows a gap since `missing` was asked."""
        last, self._last = self._last, number
        if self._publishers != 1 or last is None or number is None or number <= last + 1:
            return False
        before, self._missing = self._missing, self._missing + number - last - 1
        return not before

    def missing(self) -> int:
        """How many are missing since this was asked."""
        missing, self._missing = self._missing, 0
        return missing
