"""Whose turn it is to be read from, among those that take much of the event loop's time.

A loop reads from every socket that has something, one after the other: twenty that each take three milliseconds hold
up everybody else for sixty, in each round. So who has used up his share is not read from until his turn comes, and as
many have it in each round as take one turn's time together: others wait for those, however many there are. Addresses
take turns, and the connections of each among themselves.

Time is that of the loop's own thread, in which none passes while it waits: on a machine that is busy besides nobody's
little work seems to be much, and a share is always one of what there is.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict, deque
from collections.abc import Callable

TURN_S = 0.003
"""Work for one agent that takes longer lets all others have their turn before it goes on."""
SHARE = 0.05
"""So much of the time anybody may take without waiting: a turn is used up by what is beyond it."""
SHARE_OF_ADDRESS = 0.2
"""The same for all from one address together."""
ADDRESSES = 4096
LITTLE_S = TURN_S / 40
UNTIMED = 16
"""Of work that takes so little the thread's time is only asked for so often: to ask takes 2.4 us, a twentieth of all
that a single small message costs."""


class Share:
    """What somebody has used of his turn."""

    __slots__ = ("_at", "_share", "_spent_s")

    def __init__(self, share: float = SHARE) -> None:
        self._share = share
        self._spent_s = 0.0
        self._at = 0.0

    def spend(self, took_s: float, now: float) -> bool:
        """Work for him has taken so long; whether that was his turn, and the next one begins."""
        self._spent_s = max(0.0, self._spent_s - self._share * (now - self._at)) + took_s
        self._at = now
        if self._spent_s <= TURN_S:
            return False
        self._spent_s = 0.0
        return True


class Rounds:
    """Those of one loop that wait for their turn."""

    def __init__(self, clock: Callable[[], float] = time.thread_time) -> None:
        self._clock = clock
        self._before = clock()
        """When somebody's work was looked at last."""
        self._untimed = 0
        """How much of little work there was since."""
        self._waiting: OrderedDict[str, deque[tuple[Callable[[], object], float]]] = OrderedDict()
        self._of_address: OrderedDict[str, Share] = OrderedDict()
        self._going = False

    def spend(self, host: str, share: Share, took_s: float) -> float:
        """Work for a connection has ended just now and taken at most so long. Whether it has to wait for its turn, for
        what it has used itself or all of its address together: how long that turn may take, then; else 0."""
        together = self._of_address.get(host)
        if together is None:
            together = self._of_address[host] = Share(SHARE_OF_ADDRESS)
            if len(self._of_address) > ADDRESSES:
                self._of_address.popitem(last=False)
        if took_s < LITTLE_S and self._untimed < UNTIMED:
            self._untimed += 1
            now = self._before
        else:
            self._untimed, now = 0, self._clock()
            took_s, self._before = min(took_s, now - self._before), now
        over = together.spend(took_s, now)
        if share.spend(took_s, now):
            return TURN_S
        return took_s if over else 0.0

    def enter(self, host: str, go_on: Callable[[], object], turn_s: float = TURN_S) -> None:
        """Call this when it is the turn of this connection, in another round of the loop."""
        self._waiting.setdefault(host, deque()).append((go_on, turn_s))
        if not self._going:
            self._going = True
            asyncio.get_running_loop().call_soon(self._next)

    async def turn(self, host: str, turn_s: float = TURN_S) -> None:
        """Wait for one's turn."""
        mine: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        def go_on() -> None:
            if not mine.done():
                mine.set_result(None)

        self.enter(host, go_on, turn_s)
        await mine

    def _next(self) -> None:
        turns: list[Callable[[], object]] = []
        left_s = TURN_S
        while self._waiting and left_s > 0:
            host, waiting = self._waiting.popitem(last=False)
            go_on, turn_s = waiting.popleft()
            if waiting:
                self._waiting[host] = waiting
            turns.append(go_on)
            left_s -= turn_s
        self._going = bool(self._waiting)
        if self._going:
            asyncio.get_running_loop().call_soon(self._next)
        for go_on in turns:
            go_on()
