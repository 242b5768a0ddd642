"""What a receiver of reliable messages has missed: gaps found, asked for, closed in order. Pure: time is passed in.

A reliable source is Zenoh's advanced publisher. It numbers its messages, keeps the last ones, answers questions for
them, and tells its newest number twice a second. The receiving side is here and not Zenoh's advanced subscriber,
for three reasons (measured with Zenoh 1.10.2): that one asks once and gives up what a question that failed did not
bring, so a link lost during a recovery costs all of it; whoever subscribes late gets all that a source keeps with
the first heartbeat; and it asks for everything at once, which a slow link cannot take.

Here a gap is asked for in pieces, again and again, until the source has answered. Only what a source that answers has
no more counts as missed.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict
from dataclasses import dataclass, field
from typing import NamedTuple

Sample = tuple[str, bytes | bytearray]
"""Key and payload."""

Origin = tuple[str, str]
"""Source and key. A source is named by its sender, and a key only its own agents may use (docs/security.md): whoever
takes another's name has a count of its own."""

NUMBERS = 1 << 32
"""Sources count so far and begin again."""

PIECE_BYTES = 128 << 10
"""About so much is asked for at once: a source sends it without waiting, and its link has other things to carry."""
PIECE = 512
"""And so many messages at most."""
PAUSES_S = (0.05, 0.1, 0.2, 0.5)
"""Between questions without an answer, the last one repeated."""
OVERTAKEN_S = 0.1
"""How long a number that a heartbeat tells may come before its message."""
ATTEMPTS = 10
"""So many questions may a source that is heard leave without an answer: then it does not answer us at all."""
AWAY_S = 1.0
"""A source of which nothing is heard for so long, not even its heartbeat, is out of reach."""
SILENT_S = 60.0
"""How long a gap waits for a source that is out of reach."""
ROOM_AGAIN = 7 / 8
"""When too much waits, gaps are given up until it is less than this part of what may."""
CERTAIN = 2
"""So often a source must have answered another question and not this one: a link may be lost in between."""


class Ask(NamedTuple):
    """A question to one source."""

    source: str
    key: str
    first: int
    last: int | None
    """None: all from the first on. The newest is then among them, so that no answer means that nobody was asked."""
    piece: bool
    """Whether it asks for what is missing, and not whether the source answers at all."""

    @property
    def numbers(self) -> str:
        """As the source counts."""
        return f"{self.first % NUMBERS}..{'' if self.last is None else self.last % NUMBERS}"


@dataclass
class _Source:
    name: str
    key: str
    next: int
    """What comes before is delivered, or missed."""
    newest: int
    """The highest number that is known to exist."""
    heard_at: float
    waiting: dict[int, Sample] = field(default_factory=dict)
    waiting_bytes: int = 0
    usual_bytes: int = 1
    asked: Ask | None = None
    ask_at: float = math.inf
    replies: int = 0
    cut: bool = False
    """Whether replies were dropped on their way to us."""
    unanswered: int = 0
    gone: int = 0
    """How often what is asked for was not there, and the source was."""
    probe: bool = False
    growth: int = 0
    stranger: bool = False
    """Whether nothing of it has been delivered, and it may be older than the subscription."""
    lost: int = 0
    """Missed, and not told yet."""

    @property
    def origin(self) -> Origin:
        return self.name, self.key

    @property
    def complete(self) -> bool:
        return self.next > self.newest


class Recovery:
    """What one subscription has of each of its sources.

    Whatever comes in may free messages to deliver, which each method returns in order; `misses` tells what is lost
    for good, `asks` what to ask now, `next_deadline` when to call it again at the latest.

    Attributes:
        settled: whether all sources that existed are `known`. Of others, everything is wanted from their first
            message on.
    """

    SOURCES = 4096
    """With more, the one that was not heard for the longest time is forgotten: one that is there tells its number
    twice a second."""
    FORGOTTEN = 16_384
    """Of so many that were forgotten it is known how far they were. With more, nobody new is a stranger: what it has
    may have been delivered already."""
    WAITING = 16_384
    WAITING_BYTES = 64 << 20
    """Behind gaps, of all sources together. With more, gaps are given up."""

    def __init__(self) -> None:
        self._sources: OrderedDict[Origin, _Source] = OrderedDict()
        """The last one is the last that was heard."""
        self._open: dict[Origin, _Source] = {}
        """Those of which something is missing: few, where there are many."""
        self._forgotten: OrderedDict[Origin, int] = OrderedDict()
        self._all_remembered = True
        self._waiting = 0
        self._waiting_bytes = 0
        self.settled = False
        self._misses: list[tuple[str, int]] = []

    # -- what comes in -------------------------------------------------------------------------------------------

    def known(self, source: str, key: str, number: int, now: float) -> list[Sample]:
        """A source existed before the subscription, and this was its newest message."""
        if (source, key) in self._sources:
            return []
        freed = self._make_room()
        self._add((source, key), number + 1, now, stranger=False)
        return freed

    def sample(self, source: str, number: int, sample: Sample, now: float) -> list[Sample]:
        """A message has come."""
        origin = (source, sample[0])
        state = self._sources.get(origin)
        freed: list[Sample] = []
        if state is None:
            freed = self._make_room()
            state = self._add(origin, number, now)
        self._heard(state, now)
        number = _near(number, state.next)
        if number == state.next and not state.waiting:
            state.next += 1
            state.newest = max(state.newest, number)
            state.usual_bytes = len(sample[1])
            state.stranger = False
            if state.complete:
                self._close(state)
            freed.append(sample)
            return freed
        return freed + self._keep(state, number, sample, now)

    def heartbeat(self, source: str, key: str, number: int, now: float) -> list[Sample]:
        """A source tells its newest number. Its message may have been overtaken, so it is asked for a moment later."""
        state = self._sources.get((source, key))
        freed: list[Sample] = []
        if state is None:
            freed = self._make_room()
            state = self._add((source, key), number + 1, now)
        self._heard(state, now)
        number = _near(number, state.next)
        if number > state.newest:
            state.newest = number
            self._ask_by(state, now + OVERTAKEN_S)
        return freed

    def reply(self, ask: Ask, number: int, sample: Sample, now: float) -> list[Sample]:
        """A source sends what it was asked for. Replies come in order, so nothing before the first one is there,
        unless replies were dropped here."""
        state = self._sources.get((ask.source, ask.key))
        if state is None or sample[0] != ask.key:
            return []
        number = _near(number, state.next)
        freed: list[Sample] = []
        if state.asked is ask:
            state.replies += 1
            if state.replies == 1 and ask.piece and number > state.next and not state.cut:
                freed = self._skip(state, number)
        return freed + self._keep(state, number, sample, now)

    def reply_dropped(self, ask: Ask) -> None:
        """Of the replies to this question some did not get to us, though they came: what has not come proves nothing.
        To be called before what came after it."""
        state = self._sources.get((ask.source, ask.key))
        if state is not None and state.asked is ask:
            state.cut = True

    def ended(self, ask: Ask, now: float) -> list[Sample]:
        """A question has got all the answers that it will get."""
        state = self._sources.get((ask.source, ask.key))
        if state is None or state.asked is not ask:
            return []
        state.asked = None
        freed: list[Sample] = []
        if state.cut:
            state.unanswered = max(1, state.unanswered)  # nothing asks sooner: we have too much to do
            pause_s = PAUSES_S[-1]
        elif state.replies:
            state.unanswered = 0
            freed = self._answered(state, ask)
            pause_s = 0.0
        else:
            pause_s = self._without_answer(state, ask, now)
            if state.unanswered >= ATTEMPTS or now - state.heard_at > SILENT_S:
                freed = self._skip(state, state.newest + 1)
        if state.complete:
            self._close(state)
        else:
            state.ask_at = now + pause_s
        return freed

    def restart(self, now: float) -> None:
        """The link was lost or is back: answers on their way may not come, and what had none may have one now."""
        for state in self._open.values():
            state.asked = None
            state.unanswered = 0
            state.ask_at = now

    # -- what to do ----------------------------------------------------------------------------------------------

    def asks(self, now: float) -> list[Ask]:
        """What to ask now. Each question is to be `ended`."""
        asks = []
        for state in self._open.values():
            if state.asked is None and now >= state.ask_at:
                ask = state.asked = self._question(state)
                state.ask_at, state.replies, state.cut = math.inf, 0, False
                asks.append(ask)
        return asks

    def next_deadline(self) -> float:
        """When the next question is due; infinite when none is."""
        return min((state.ask_at for state in self._open.values()), default=math.inf)

    def misses(self) -> list[tuple[str, int]]:
        """What has been lost for good since the last call: (key, how many)."""
        misses, self._misses = self._misses, []
        return misses

    # -- one source ----------------------------------------------------------------------------------------------

    def _add(self, origin: Origin, first: int, now: float, *, stranger: bool = True) -> _Source:
        """A source from which ``first`` is wanted on; from a stranger, all that it has; from one that was forgotten,
        what comes after that."""
        stranger = stranger and self.settled and self._all_remembered
        first = 0 if stranger else first
        if (before := self._forgotten.pop(origin, None)) is not None:
            first, stranger = before, False
        state = self._sources[origin] = _Source(*origin, first, first - 1, now, stranger=stranger)
        return state

    def _make_room(self) -> list[Sample]:
        """For one more source; what waits of the one that goes is delivered."""
        if len(self._sources) < self.SOURCES:
            return []
        origin, state = next(iter(self._sources.items()))
        freed = self._skip(state, state.newest + 1)
        del self._sources[origin]
        self._open.pop(origin, None)
        self._forgotten[origin] = state.next
        if len(self._forgotten) > self.FORGOTTEN:
            self._forgotten.popitem(last=False)
            self._all_remembered = False
        return freed

    def _heard(self, state: _Source, now: float) -> None:
        """There is a way to the source now; if there was none for a while, ask again at once."""
        self._sources.move_to_end(state.origin)
        if now - state.heard_at > AWAY_S and not state.complete:
            state.unanswered = 0
            self._ask_by(state, now)
        state.heard_at = now

    def _keep(self, state: _Source, number: int, sample: Sample, now: float) -> list[Sample]:
        """Keep a message until its turn; those whose turn it is."""
        if number < state.next or number in state.waiting:
            return []
        size = len(sample[1])
        state.waiting[number] = sample
        state.waiting_bytes += size
        self._waiting += 1
        self._waiting_bytes += size
        state.usual_bytes = size
        state.newest = max(state.newest, number)
        freed = self._in_turn(state)
        if state.complete:
            self._close(state)
        else:
            self._ask_by(state, now)
        if self._is_full():
            freed += self._give_up()
        return freed

    def _is_full(self, part: float = 1.0) -> bool:
        return self._waiting > part * self.WAITING or self._waiting_bytes > part * self.WAITING_BYTES

    def _give_up(self) -> list[Sample]:
        """Go on without the first of what is missing where most waits. The key that has most loses, however many
        sources it has: who invents them does it to its own key. It is looked for once for many messages."""
        share = self._share_of
        freed: list[Sample] = []
        while self._is_full(ROOM_AGAIN):
            of_key: Counter[str] = Counter()
            for state in self._open.values():
                of_key[state.key] += share(state)
            ((most, _),) = of_key.most_common(1)
            behind = [state for state in self._open.values() if state.key == most and state.waiting]
            for state in sorted(behind, key=share, reverse=True):
                numbers = sorted(state.waiting)
                freed += self._skip(state, numbers[len(numbers) // 4])
                if state.complete:
                    self._close(state)
                if not self._is_full(ROOM_AGAIN):
                    break
        return freed

    def _share_of(self, state: _Source) -> int:
        """Of the room for what waits, in units of its smallest part: messages and bytes count the same."""
        return len(state.waiting) * (self.WAITING_BYTES // self.WAITING) + state.waiting_bytes

    def _in_turn(self, state: _Source) -> list[Sample]:
        freed = []
        while state.next in state.waiting:
            sample = self._take(state, state.next)
            state.next += 1
            freed.append(sample)
        state.stranger = state.stranger and not freed
        if freed and state.lost:
            self._misses.append((state.key, state.lost))
            state.lost = 0
        return freed

    def _take(self, state: _Source, number: int) -> Sample:
        sample = state.waiting.pop(number)
        state.waiting_bytes -= len(sample[1])
        self._waiting -= 1
        self._waiting_bytes -= len(sample[1])
        return sample

    def _skip(self, state: _Source, to: int) -> list[Sample]:
        """Go on with this number: what has not come of those before is lost."""
        there = sorted(number for number in state.waiting if number < to)
        if not state.stranger:
            state.lost += to - state.next - len(there)
        freed = [self._take(state, number) for number in there]
        state.next = to
        freed += self._in_turn(state)
        state.stranger = state.stranger and not freed
        if state.complete and state.lost:
            self._misses.append((state.key, state.lost))
            state.lost = 0
        return freed

    # -- questions -----------------------------------------------------------------------------------------------

    def _ask_by(self, state: _Source, at: float) -> None:
        self._open[state.origin] = state
        if state.asked is None and not state.unanswered:
            state.ask_at = min(state.ask_at, at)

    def _question(self, state: _Source) -> Ask:
        if state.probe:
            return Ask(state.name, state.key, state.newest, None, piece=False)
        last = state.next + self._piece(state) - 1
        return Ask(state.name, state.key, state.next, last if last < state.newest else None, piece=True)

    def _piece(self, state: _Source) -> int:
        """How many messages to ask for. It grows while the source has nothing: the gap may be long, and empty."""
        return max(1, min(PIECE, PIECE_BYTES // max(1, state.usual_bytes))) << state.growth

    def _answered(self, state: _Source, ask: Ask) -> list[Sample]:
        if ask.piece:
            state.gone = state.growth = 0
            return []
        state.probe = False
        state.gone += 1
        if state.gone < CERTAIN:
            return []
        state.gone = 0
        freed = self._skip(state, min(state.next + self._piece(state), state.newest + 1))
        state.growth = min(state.growth + 1, 16)
        return freed

    def _without_answer(self, state: _Source, ask: Ask, now: float) -> float:
        """Nothing came: it is not there, or nobody was asked. The pause until the next question."""
        if ask.last is not None:
            state.probe = True  # whether the source answers at all
            return 0.0
        state.probe = False
        state.gone = 0
        pause_s = PAUSES_S[min(state.unanswered, len(PAUSES_S) - 1)]
        if now - state.heard_at <= AWAY_S:
            state.unanswered += 1
        return pause_s

    def _close(self, state: _Source) -> None:
        """Nothing is missing."""
        self._open.pop(state.origin, None)
        state.ask_at = math.inf
        state.unanswered = state.gone = state.growth = 0
        state.probe = False


def _near(number: int, expected: int) -> int:
    """The number as it goes on counting where a source has begun again."""
    half = NUMBERS // 2
    return expected + (number - expected + half) % NUMBERS - half
