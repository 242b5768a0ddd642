"""What the traffic rules say about a key, and whether a message may pass. Pure: times are passed in.

The rules of a settings file (`TrafficRule`) become one `Policy` for each key that is sent to. A message that is too
much is dropped, whole and at once: nothing waits here, because all that waits in front of a limit comes late. Each
drop has a reason, ``over_size``, ``over_rate`` or ``over_budget``.
"""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

from ..config import Priority, TrafficRule
from .key_expressions import fits
from .rate import Rate

BURST_S = 0.1
"""So much of a rate or a budget may come at once, and one message more: senders and their machines are not regular."""

REASONS = {"max_bytes": "over_size", "max_hz": "over_rate", "max_bytes_per_s": "over_budget"}
"""Settings that limit, in the order in which they are asked, and how it is counted when they refuse."""

OTHER_KEYS = "other keys"

T = TypeVar("T")


class Overrun(NamedTuple):
    """Why a message must not pass."""

    reason: str
    rule: str
    """What the rule matches."""
    setting: str
    limit: float
    first: bool
    """Whether it is the first of this rule with this reason."""


class Limit:
    """One limiting setting of one rule."""

    def __init__(self, rule: TrafficRule, setting: str) -> None:
        self.rule = rule.match
        self.setting = setting
        self.value: float = getattr(rule, setting)
        self._pace = None if setting == "max_bytes" else Rate(self.value, BURST_S)

    def allows(self, size: int, now: float) -> bool:
        """Whether a message of this size may pass now."""
        return size <= self.value if self._pace is None else self._pace.allows(now)

    def take(self, size: int, now: float) -> None:
        """It passes."""
        if self._pace is not None:
            self._pace.take(1 if self.setting == "max_hz" else size, now)


class Policy:
    """What holds for one key. Made by `Policer.of`.

    Attributes:
        key: without wildcards.
        priority: instead of that of the message's class; None leaves it.
        cache: how many messages the source keeps for receivers that missed some; None: none.
        limited: whether `judge` can refuse anything.
    """

    def __init__(
        self, policer: Policer, key: str, priority: Priority | None, cache: int | None, limits: Sequence[Limit]
    ) -> None:
        self.key = key
        self.priority = priority
        self.cache = cache
        self.limited = bool(limits)
        self._policer = policer
        self._limits = limits

    def judge(self, size: int, now: float) -> Overrun | None:
        """Let a message pass, or count it as dropped and say why. From any thread."""
        with self._policer.lock:
            for limit in self._limits:
                if not limit.allows(size, now):
                    return self._policer.count(limit, self.key)
            for limit in self._limits:
                limit.take(size, now)
        return None

    def too_large(self, size: int) -> Overrun | None:
        """The same with the limit on size only, for what must not be lost without an answer."""
        with self._policer.lock:
            for limit in self._limits:
                if limit.setting == "max_bytes" and not limit.allows(size, 0.0):
                    return self._policer.count(limit, self.key)
        return None


class Policer:
    """The rules of one program.

    Of the rules that fit a key, each setting comes from the first one that gives it. ``max_hz`` holds for each key,
    ``max_bytes_per_s`` for all keys together that have it from the same rule.

    Attributes:
        totals: what was dropped, by reason; the counter that was passed in.
        drops: the same by (rule, reason, key).
    """

    KEYS = 4096
    """Keys are remembered up to here, as they come from the network; the pace of a forgotten one begins anew."""

    def __init__(self, rules: Sequence[TrafficRule] = (), totals: Counter[str] | None = None) -> None:
        self.totals: Counter[str] = Counter() if totals is None else totals
        self.drops: Counter[tuple[str, str, str]] = Counter()
        self.lock = threading.Lock()
        self._rules = list(rules)
        self._shared = {
            (number, setting): Limit(rule, setting)
            for number, rule in enumerate(self._rules)
            for setting in ("max_bytes", "max_bytes_per_s")
            if getattr(rule, setting) is not None
        }
        self._shapes: OrderedDict[str, Policy] = OrderedDict()
        self._free: OrderedDict[str, None] = OrderedDict()
        """Keys that no rule fits: by themselves, so that they push nobody's pace out."""
        self._first: set[tuple[str, str]] = set()

    def of(self, key: str) -> Policy | None:
        """What holds for a key; None when no rule fits it. From any thread."""
        if not self._rules:
            return None
        with self.lock:
            if key in self._free:
                return None
            shape = self._shapes.get(key)
            if shape is None:
                shape = self._shape(key)
                if shape is None:
                    _remember(self._free, key, None, self.KEYS)
                else:
                    _remember(self._shapes, key, shape, self.KEYS)
            return shape

    def count(self, limit: Limit, key: str) -> Overrun:
        """A message is dropped. With the lock held."""
        reason = REASONS[limit.setting]
        drop = (limit.rule, reason, key)
        if drop not in self.drops and len(self.drops) >= self.KEYS:
            drop = (limit.rule, reason, OTHER_KEYS)
        self.drops[drop] += 1
        self.totals[reason] += 1
        first = (limit.rule, reason) not in self._first
        self._first.add((limit.rule, reason))
        return Overrun(reason, limit.rule, limit.setting, limit.value, first)

    def report(self, keys: int = 5) -> list[str]:
        """One line for each rule and reason: how much was dropped, and on which keys most."""
        by_rule: dict[tuple[str, str], Counter[str]] = {}
        with self.lock:
            for (rule, reason, key), count in self.drops.items():
                by_rule.setdefault((rule, reason), Counter())[key] = count
        lines = []
        for (rule, reason), by_key in sorted(by_rule.items()):
            most = ", ".join(f"{key} {count}" for key, count in by_key.most_common(keys))
            more = f" and {len(by_key) - keys} keys more" if len(by_key) > keys else ""
            lines.append(f"traffic rule {rule}: {reason} {by_key.total()}, on {most}{more}")
        return lines

    def _shape(self, key: str) -> Policy | None:
        fitting = [(number, rule) for number, rule in enumerate(self._rules) if fits(rule.match, key)]
        if not fitting:
            return None
        limits: list[Limit] = []
        for setting in REASONS:
            for number, rule in fitting:
                if getattr(rule, setting) is not None:
                    limits.append(self._shared.get((number, setting)) or Limit(rule, setting))
                    break
        rules = [rule for _, rule in fitting]
        priority: Priority | None = _first_given(rule.priority for rule in rules)
        return Policy(self, key, priority, _first_given(rule.cache for rule in rules), limits)


def _remember(among: OrderedDict[str, T], key: str, value: T, limit: int) -> None:
    among[key] = value
    if len(among) > limit:
        among.popitem(last=False)


def _first_given(values: Iterable[T | None]) -> T | None:
    return next((value for value in values if value is not None), None)
