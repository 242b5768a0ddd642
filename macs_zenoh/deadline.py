"""One call that is due at some time, and at another time when that changes. Asyncio."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

LATE_S = 0.001
"""So much later it is called: a loop may call earlier by what its clock cannot tell apart, and who is called looks at
a clock again."""


class Deadline:
    """Calls ``call`` on the loop once it is due. Times are those of `time.monotonic`."""

    def __init__(self, call: Callable[[], object]) -> None:
        self._call = call
        self._timer: asyncio.TimerHandle | None = None

    @property
    def is_set(self) -> bool:
        """Whether a call is to come."""
        return self._timer is not None

    def set(self, at: float | None) -> None:
        """Be due then, and no more when it was; None: not at all."""
        self.cancel()
        if at is not None:
            delay_s = max(0.0, at - time.monotonic()) + LATE_S
            self._timer = asyncio.get_running_loop().call_later(delay_s, self._due)

    def cancel(self) -> None:
        """Not be due any more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _due(self) -> None:
        self._timer = None
        self._call()
