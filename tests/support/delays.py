"""How long the machine kept programs from running: what a test that says how long something takes has to allow.

A process of its own wants to run every two milliseconds, and adds up how much later it came to it. On a machine with
nothing else to do that is next to nothing, so a limit is as strict there as it reads.
"""

from __future__ import annotations

import select
import subprocess
import sys
import time
from types import TracebackType

from tests.support.processes import ROOT

EVERY_S = 0.002
USUAL_S = 0.0003
"""As late as this is a timer anywhere."""
STATIONS = 4
"""So many programs and threads one after the other may each have been kept waiting that long."""


class Delays:
    """What is measured while its block runs."""

    def __enter__(self) -> Delays:
        pipe = subprocess.PIPE
        self._probe = subprocess.Popen(
            [sys.executable, "-m", "tests.support.delays"], cwd=ROOT, stdin=pipe, stdout=pipe, text=True
        )
        self.s()  # it runs
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._probe.communicate()

    def s(self) -> float:
        """How much longer than on an idle machine something may have taken since the last call, in seconds."""
        assert self._probe.stdin is not None
        assert self._probe.stdout is not None
        self._probe.stdin.write("\n")
        self._probe.stdin.flush()
        return STATIONS * float(self._probe.stdout.readline())


def main() -> None:
    """The probe: a line in, the seconds lost since the last one out, until its input ends."""
    lost_s = 0.0
    while True:
        began = time.monotonic()
        asked, _, _ = select.select([sys.stdin], [], [], EVERY_S)
        if not asked:
            lost_s += max(0.0, time.monotonic() - began - EVERY_S - USUAL_S)
        elif not sys.stdin.readline():
            return
        else:
            print(lost_s, flush=True)
            lost_s = 0.0


if __name__ == "__main__":
    main()
