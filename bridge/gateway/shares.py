"""Whose turn it is to be read from, among those that take much of the event loop's time.

A loop reads from every socket that has something, one after the other: twenty that each take three milliseconds hold
up everybody else for sixty, in each round. So who has used up his share is not read from until his turn comes, and as
many have it in each round as take one turn's time together: others wait for those, however many there are. Addresses
take turns. Of one address, behind which there may be many, who has had little of late comes before those who have had
much: his may be a stop, and twenty others would be up to twenty turns.

Many that each take little take much as well: of an address that is beyond its share no more is done in a round, once
that round has had a turn's time for such addresses. What has been read waits, and what is to be encrypted for it.

Time is that of the loop's own thread, in which none passes while it waits: on a machine that is busy besides nobody's
little work seems to be much, and a share is always one of what there is.
"""

from __future__ import annotations

import asyncio
import heapq
import math
import time
from collections import OrderedDict
from collections.abc import Callable
from itertools import count

TURN_S = 0.003
"""Work for one agent that takes longer lets all others have their turn before it goes on."""
SHARE = 0.05
"""So much of the time anybody may take without waiting: a turn is used up by what is beyond it."""
SHARE_OF_ADDRESS = 0.2
"""The same for all from one address together."""
LONG_S = 2 * TURN_S
"""A round that has had so much of anybody's work is long."""
NOTED_S = TURN_S / 10
"""Work that takes less begins no round, as it would cost more than it tells."""
BUSY_S = 0.1
"""So long after it was last beyond its share an address counts as one that takes much."""
RECENT_S = 1.0
"""What anybody had is forgotten after so long."""
MUCH_S = RECENT_S / 50
"""Who had so much waits longest."""
LITTLE_HAD_S = 2 * TURN_S
"""Who has had less of late has had little."""
OVER_READ_BYTES = 64
"""Of who takes much himself, and has his turn in another round of the loop. Who only shares his address does not have
a command read in such pieces, each in its own turn: it may be a stop."""
LATE_READ_BYTES = 512
"""In a round of the loop that has been long already so much is read of anybody else until the next one: of many who
begin to flood in the same moment each has his first turn before him."""
LATEST_S = 1.0
"""So much longer at most he waits for others of his address, who have had less: nobody waits for ever."""
ADDRESSES = 4096
LITTLE_S = TURN_S / 40
UNTIMED = 16
"""Of work that takes so little the thread's time is only asked for so often: to ask takes 2.4 us, a twentieth of all
that a single small message costs."""


class Share:
    """What somebody has used of his turn."""

    __slots__ = ("_at", "_had_s", "_share", "_spent_s", "busy_until")

    def __init__(self, share: float = SHARE) -> None:
        self._share = share
        self._spent_s = 0.0
        self._had_s = 0.0
        self._at = 0.0
        self.busy_until = -math.inf

    def spend(self, took_s: float, now: float) -> bool:
        """Work for him has taken so long; whether that was his turn, and the next one begins."""
        self._spent_s = max(0.0, self._spent_s - self._share * (now - self._at)) + took_s
        self._had_s = self.had_s(now) + took_s
        self._at = now
        if self._spent_s <= TURN_S:
            return False
        self._spent_s = 0.0
        self.busy_until = now + BUSY_S
        return True

    def had_s(self, now: float) -> float:
        """How much of the time he had of late."""
        return self._had_s * max(0.0, 1.0 - (now - self._at) / RECENT_S)


class Rounds:
    """Those of one loop that wait for their turn."""

    def __init__(self, clock: Callable[[], float] = time.thread_time) -> None:
        self._clock = clock
        self._before = clock()
        """When somebody's work was looked at last."""
        self._untimed = 0
        """How much of little work there was since."""
        self._waiting: OrderedDict[str, list[tuple[float, int, Callable[[], object], float]]] = OrderedDict()
        """By address, a heap: when each is due, which of those that are due then, what goes on, and for how long at
        least."""
        self._entered = count()
        self._of_address: OrderedDict[str, Share] = OrderedDict()
        self._round_s = 0.0
        """What this round has had of work for addresses that take much."""
        self._all_s = 0.0
        """What it has had of anybody's."""
        self._busy_until = -math.inf
        """So long there is any."""
        self._going = False
        """Whether the next round is waited for."""

    def spend(self, host: str, share: Share, took_s: float) -> float:
        """Work for a connection has ended just now and taken at most so long. Whether it has to wait for its turn, for
        what it has used itself or all of its address together: how long that turn may take, then; else 0."""
        took_s, now, over = self._count(host, took_s)
        if share.spend(took_s, now):
            return TURN_S
        return took_s if over else 0.0

    def add(self, took_s: float) -> None:
        """Work for whoever it may be has taken so long: while any address takes much, that is of its round."""
        if self._before < self._busy_until:
            self._round_s += took_s

    def _count(self, host: str, took_s: float) -> tuple[float, float, bool]:
        """How long it was, as far as this thread had a processor; until when; and whether the address is over."""
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
        if self._going:
            self._all_s += took_s
        elif took_s >= NOTED_S:
            self._await_round()
            self._all_s = took_s
        if now < together.busy_until:
            self._busy_until = max(self._busy_until, together.busy_until)
            self._round_s += took_s
        return took_s, now, over

    @property
    def long(self) -> bool:
        """Whether this round has had much work already, whoever it was for."""
        return self._all_s > LONG_S

    def had_little(self, share: Share) -> bool:
        """Whether who has this share has had little of late, as who sends commands: one of them may be a stop."""
        return share.had_s(self._before) < LITTLE_HAD_S

    def most_bytes(self, host: str, share: Share, usual: int) -> int:
        """How much to read at once of who has this share, of whom it is as much as is usual in other rounds."""
        is_over = self.are_over(host)
        if is_over and not self.had_little(share):
            return OVER_READ_BYTES
        return min(LATE_READ_BYTES, usual) if is_over or self.long else usual

    def are_over(self, host: str) -> bool:
        """Whether work for this address has to wait for another round: it takes much, and this round has had a turn's
        time for those that do."""
        together = self._of_address.get(host)
        if together is None or self._before >= together.busy_until:
            return False
        if not self._going:
            self._round_s = 0.0
            self._await_round()
        return self._round_s > TURN_S

    def enter(self, host: str, share: Share | None, go_on: Callable[[], object], turn_s: float = TURN_S) -> None:
        """Call this when it is the turn of who has this share, in another round of the loop. It takes at least so long
        of that round's time. None: nobody knows what it takes; then it waits as if that had been much."""
        had_s = MUCH_S if share is None else min(MUCH_S, share.had_s(self._before))
        due = self._before + LATEST_S * had_s / MUCH_S
        heapq.heappush(self._waiting.setdefault(host, []), (due, next(self._entered), go_on, turn_s))
        self._await_round()

    def _await_round(self) -> None:
        if not self._going:
            self._going = True
            asyncio.get_running_loop().call_soon(self._next)

    async def turn(self, host: str, share: Share | None, turn_s: float = TURN_S) -> None:
        """Wait for one's turn, as in `enter`."""
        mine: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        def go_on() -> None:
            if not mine.done():
                mine.set_result(None)

        self.enter(host, share, go_on, turn_s)
        await mine

    def _next(self) -> None:
        self._going, self._round_s, self._all_s, left_s = False, 0.0, 0.0, TURN_S
        if self._waiting:
            self._await_round()  # before those that go on: what they have read from now on is of that round
        for _ in range(sum(map(len, self._waiting.values()))):
            host, waiting = self._waiting.popitem(last=False)
            _, _, go_on, turn_s = heapq.heappop(waiting)
            if waiting:
                self._waiting[host] = waiting
            began = time.monotonic()
            go_on()
            left_s -= max(turn_s, time.monotonic() - began)
            if left_s <= 0:
                break
