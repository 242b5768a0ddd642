"""Cores that wake fast while messages pass."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Callable

log = logging.getLogger("macs.mesh")


class Awake:
    """Asks Linux, while messages pass, to let no core of this machine sleep so deeply that it needs more than
    ``latency_us`` to wake; 0: not to let them sleep at all.

    A request of PM QoS, which Linux drops when whoever made it is gone, however that came about. ``stirred`` says
    whether a message has passed since it was asked last.
    """

    DEVICE = "/dev/cpu_dma_latency"
    LOOK_S = 0.25
    QUIET_S = 2.0
    """Without a message for so long, cores may sleep again."""

    def __init__(self, latency_us: int, stirred: Callable[[], bool], loop: asyncio.AbstractEventLoop) -> None:
        self._latency_us = latency_us
        self._stirred = stirred
        self._loop = loop
        self._request: int | None = None
        self._quiet_s = 0.0
        self._timer: asyncio.TimerHandle | None = None
        if self._hold():  # who may not do it learns that at the start
            self._release()
            self._timer = loop.call_later(self.LOOK_S, self._look)

    def close(self) -> None:
        """Withdraw the request, for good. Closing twice is allowed."""
        if self._timer is not None:
            self._timer.cancel()
        self._release()

    def _look(self) -> None:
        self._timer = self._loop.call_later(self.LOOK_S, self._look)
        self._quiet_s = 0.0 if self._stirred() else self._quiet_s + self.LOOK_S
        if self._quiet_s == 0.0 and self._request is None:
            self._hold()
        elif self._quiet_s >= self.QUIET_S:
            self._release()

    def _hold(self) -> bool:
        try:
            self._request = os.open(self.DEVICE, os.O_WRONLY)
            os.write(self._request, self._latency_us.to_bytes(4, sys.byteorder))
        except OSError as error:
            text = "awake_us has no effect: %s: %s (docs/robot.md says who may open it)"
            log.warning(text, self.DEVICE, error.strerror or error)
            self.close()
            return False
        return True

    def _release(self) -> None:
        request, self._request = self._request, None
        if request is not None:
            os.close(request)
