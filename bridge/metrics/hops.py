"""How long hops of traced messages took, in buckets, for Prometheus. Pure.

Hops are called by what they are and not by whose, so that there are few, whatever there is on the mesh; between two
hosts they are known as well as their clocks agree.
"""

from __future__ import annotations

from collections.abc import Sequence

from macs_zenoh.protocol.trace import DONE, IN, PUT, RECEIVED, ROS_SENT, ROUTER, SENT, SOCKET, TAKEN, Report

from .families import Histogram

BUCKETS_S = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.02, 0.1)

_NAMES = {
    (ROS_SENT, TAKEN): "ros_to_agent",
    (TAKEN, PUT): "agent",
    (SOCKET, PUT): "gateway_in",
    (PUT, SENT): "into_zenoh",
    (SENT, ROUTER): "to_router",
    (ROUTER, ROUTER): "between_routers",
    (ROUTER, RECEIVED): "from_router",
    (RECEIVED, IN): "out_of_zenoh",
    (IN, DONE): "handled",
}


class HopTimes:
    """Takes reports of traced messages. From any thread; of two that come in one moment one may be missed."""

    def __init__(self) -> None:
        self._counts: dict[str, list[int]] = {}
        self._sums: dict[str, float] = {}

    def take(self, report: Report) -> None:
        """One message."""
        for before, after in zip(report.points, report.points[1:], strict=False):
            name = _NAMES.get((before[0], after[0]))
            if name is not None:
                self._add(name, max(0.0, (after[1] - before[1]) / 1e9))

    def _add(self, name: str, took_s: float) -> None:
        counts = self._counts.setdefault(name, [0] * (len(BUCKETS_S) + 1))
        counts[_bucket(BUCKETS_S, took_s)] += 1
        self._sums[name] = self._sums.get(name, 0.0) + took_s

    def histogram(self) -> Histogram:
        """All of it."""
        made = Histogram("macs_hop_seconds", "hops of messages that were traced", BUCKETS_S)
        for name, counts in sorted(self._counts.items()):
            made.rows[name] = (list(counts), self._sums[name])
        return made


def _bucket(bounds: Sequence[float], value: float) -> int:
    return next((at for at, bound in enumerate(bounds) if value <= bound), len(bounds))
