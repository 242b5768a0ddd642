"""How often messages come, how much they carry and how old they are: over the last so many of them. Pure.

The lines are those of ``ros2 topic hz``, ``bw`` and ``delay``.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

RATE_WINDOW, SIZE_WINDOW = 10_000, 100
"""Messages that count unless asked otherwise, as ros2cli has it."""


@dataclass(frozen=True)
class Spread:
    """Least, greatest, mean and standard deviation of some numbers."""

    least: float
    greatest: float
    mean: float
    deviation: float

    @classmethod
    def of(cls, numbers: Iterable[float]) -> Spread:
        """Of at least one number."""
        all_ = list(numbers)
        mean = math.fsum(all_) / len(all_)
        deviation = math.sqrt(math.fsum((number - mean) ** 2 for number in all_) / len(all_))
        return cls(min(all_), max(all_), mean, deviation)


class Arrivals:
    """When messages came: how often they come."""

    NAMES = ("rate_hz", "min_s", "max_s", "std_dev_s", "window")

    def __init__(self, window: int = RATE_WINDOW) -> None:
        self._intervals: deque[float] = deque(maxlen=window)
        self._last_s: float | None = None

    def came(self, at_s: float) -> None:
        """A message, by the monotonic clock."""
        if self._last_s is not None:
            self._intervals.append(at_s - self._last_s)
        self._last_s = at_s

    def facts(self) -> tuple[float | int, ...] | None:
        """What `NAMES` says, None before two messages."""
        if not self._intervals:
            return None
        spread = Spread.of(self._intervals)
        rate_hz = 1 / spread.mean if spread.mean > 0 else math.inf
        return (rate_hz, spread.least, spread.greatest, spread.deviation, len(self._intervals) + 1)

    def lines(self) -> str | None:
        """The same for people."""
        facts = self.facts()
        if facts is None:
            return None
        return _spread_lines("rate", *facts)


class Sizes:
    """How large messages are, and how much comes in a second."""

    NAMES = ("bytes_per_s", "mean_bytes", "min_bytes", "max_bytes", "window")

    def __init__(self, window: int = SIZE_WINDOW) -> None:
        self._came: deque[tuple[float, int]] = deque(maxlen=window)

    def came(self, at_s: float, size: int) -> None:
        """A message of so many bytes of CDR."""
        self._came.append((at_s, size))

    def facts(self) -> tuple[float | int, ...] | None:
        """What `NAMES` says, None before two messages. The first one of the window only begins its time."""
        if len(self._came) < 2:
            return None
        took_s = self._came[-1][0] - self._came[0][0]
        sizes = [size for _, size in self._came]
        rate = sum(sizes[1:]) / took_s if took_s > 0 else math.inf
        return (rate, sum(sizes) / len(sizes), min(sizes), max(sizes), len(sizes))

    def lines(self) -> str | None:
        """The same for people."""
        facts = self.facts()
        if facts is None:
            return None
        rate, mean, least, greatest, window = facts
        return (
            f"{bytes_of(rate)}/s from {window} messages\n"
            f"\tMessage size mean: {bytes_of(mean)} min: {bytes_of(least)} max: {bytes_of(greatest)}"
        )


class Ages:
    """How old messages are when they come, by the time in their header."""

    NAMES = ("delay_s", "min_s", "max_s", "std_dev_s", "window")

    def __init__(self, window: int = RATE_WINDOW) -> None:
        self._ages: deque[float] = deque(maxlen=window)

    def came(self, age_s: float) -> None:
        """A message that is so old."""
        self._ages.append(age_s)

    def facts(self) -> tuple[float | int, ...] | None:
        """What `NAMES` says, None before a message."""
        if not self._ages:
            return None
        spread = Spread.of(self._ages)
        return (spread.mean, spread.least, spread.greatest, spread.deviation, len(self._ages))

    def lines(self) -> str | None:
        """The same for people."""
        facts = self.facts()
        if facts is None:
            return None
        return _spread_lines("delay", *facts)


def _spread_lines(what: str, average: float, least: float, greatest: float, deviation: float, window: float) -> str:
    return (
        f"average {what}: {average:.3f}\n"
        f"\tmin: {least:.3f}s max: {greatest:.3f}s std dev: {deviation:.5f}s window: {window}"
    )


def bytes_of(number: float) -> str:
    """``941 B``, ``12.50 KB``, ``3.41 MB``, as ros2cli counts: by thousands."""
    if number < 1000:
        return f"{number:.0f} B"
    for unit in ("KB", "MB"):
        number /= 1000
        if number < 1000:
            return f"{number:.2f} {unit}"
    return f"{number / 1000:.2f} GB"
