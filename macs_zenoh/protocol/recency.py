"""How old what a TCP agent says can be at most. Pure.

Nothing in a command of an existing headset tells when it was said: one that waited in the headset's own connection,
while its Wi-Fi stood still, looks like one that it says now, however fast or slowly those come that waited with it.
But a headset answers whenever it is told its id, in the same stream as all that it says (docs/protocol.md). So who
drives is told its id again and again, each time with another number, and what comes behind an answer was said after
that question.
"""

from __future__ import annotations

import math

QUESTIONS = 1 << 30
"""Numbers of questions are larger; those of connections are smaller."""


class Recency:
    """Of one TCP agent. It counts only once its answers have come soon: not every program answers, and those of one
    that reads slowly say nothing."""

    EVERY_S = 0.4
    """So often it is asked."""
    RECENT_S = 1.0
    """What is at most so old is carried out."""
    QUICK_S = 0.5
    """Answers that take longer prove nothing."""
    SLOW = 4
    """So many of these in a row, and none that does not come tells anything any more."""
    OPEN = 4
    """So many questions may be open: what nobody takes should not fill its link."""
    LOST_S = 10.0
    """A question that was not answered for so long is open no more: it got lost, or its answer did."""

    def __init__(self) -> None:
        self.is_quick = False
        """Whether its answers come so soon that one which does not come tells something."""
        self._slow = 0
        self._number = QUESTIONS
        self._open: list[tuple[int, float]] = []
        self._since = -math.inf
        """What comes now was said after this."""

    def ask(self, now: float) -> int | None:
        """A question is asked now: its number. None: so many are open that it had better not be."""
        while self._open and now - self._open[0][1] > self.LOST_S:
            del self._open[0]
        if len(self._open) >= self.OPEN:
            return None
        self._number += 1
        self._open.append((self._number, now))
        return self._number

    def answered(self, number: int, now: float, steady_since: float) -> None:
        """An answer came. If all else that the agent says has come steadily since before the question, and the answer
        took long nevertheless, that was on the way to the agent."""
        at = next((at for asked, at in self._open if asked == number), None)
        if at is None:
            return
        while self._open.pop(0)[0] != number:
            pass  # it answers in order, if at all
        self._since = at
        if now - at <= self.QUICK_S:
            self.is_quick, self._slow = True, 0
        elif steady_since <= at:
            self._slow += 1
            self.is_quick = self.is_quick and self._slow < self.SLOW

    def age_at_most(self, now: float) -> float:
        """How old what comes now can be, in s; infinite when nothing is known."""
        return now - self._since
