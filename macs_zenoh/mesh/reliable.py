"""A subscription that recovers what it missed, from sources that keep it. See `macs_zenoh.protocol.recovery`."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Callable, Iterator
from functools import partial

import zenoh

from macs_zenoh.deadline import Deadline
from macs_zenoh.protocol import keyexpr
from macs_zenoh.protocol.recovery import Ask, Recovery

from .arrivals import Arrivals
from .declared import AtOnce, Numbered, OnBatch, OnMiss, OnNumbered, Sample, Subscription

log = logging.getLogger("macs.mesh")


class Recovered:
    """A subscription that asks reliable sources for what it missed. On the loop."""

    ASK_S = 3.0
    """How long a question may take; what it has brought until then stays."""
    AGAIN_S = 0.5
    """After so long it is asked again which sources exist, when answers had to be dropped."""

    def __init__(
        self,
        session: zenoh.Session,
        arrivals: Arrivals,
        key: str,
        on_batch: OnBatch,
        on_miss: OnMiss,
        *,
        at_once: AtOnce | None,
        patient: bool,
        linked: bool,
        on_close: Callable[[Recovered], None],
    ) -> None:
        self._session = session
        self._arrivals = arrivals
        self._loop = asyncio.get_running_loop()
        self._linked = linked
        self._on_close = on_close
        self._key = key
        self._on_batch = on_batch
        self._at_once = at_once
        self._patient = patient
        self._on_miss = on_miss
        self._recovery = Recovery()
        self._deadline = Deadline(lambda: self._go_on([]))
        self._closed = False
        self._on_numbered = self._numbered
        self._on_heartbeat = self._heartbeat

    def declare(self) -> Subscription:
        """Subscribe, and learn how far those sources are that exist."""
        session, arrivals = self._session, self._arrivals
        receive = arrivals.receiver(self._on_batch, self._on_numbered, at_once=self._at_once, patient=self._patient)
        samples = zenoh.handlers.Callback(receive, indirect=False)
        beat = arrivals.receiver(self._on_heartbeat)
        heartbeats = zenoh.handlers.Callback(beat, indirect=False)
        declared = Subscription(
            self,
            session.declare_subscriber(self._key, samples),
            session.declare_subscriber(keyexpr.sources(self._key), heartbeats),
        )
        self._look_for_sources()
        return declared

    def undeclare(self) -> None:
        """Ask nothing any more."""
        self._closed = True
        self._on_close(self)
        self._deadline.cancel()

    def link_changed(self, linked: bool) -> None:
        """The way to the sources was lost or is there again."""
        self._linked = linked
        self._recovery.restart(time.monotonic())
        if linked and not self._recovery.settled:
            self._look_for_sources()
        self._go_on([])

    def _look_for_sources(self) -> None:
        """Ask every source for its newest number, so that only what it sends from now on is wanted."""
        linked = self._linked
        dropped: list[bool] = []

        def known(batch: Iterator[Numbered]) -> None:
            freed: list[Sample] = []
            for key, _, source, number in batch:
                freed += self._recovery.known(source, key, number, time.monotonic())
            self._go_on(freed)

        def ended(_: Iterator[Sample]) -> None:
            if dropped and not self._closed:
                self._loop.call_later(self.AGAIN_S, self._look_for_sources)
            elif linked and self._linked:  # else once there is a router
                self._recovery.settled = True

        self._get(f"{keyexpr.sources(self._key)}?_max=1", known, ended, dropped)

    def _numbered(self, batch: Iterator[Numbered]) -> None:
        now = time.monotonic()
        recovery, freed = self._recovery, []
        for key, payload, source, number in batch:
            freed += recovery.sample(source, number, (key, payload), now)
        self._go_on(freed)

    def _heartbeat(self, batch: Iterator[Sample]) -> None:
        now = time.monotonic()
        freed: list[Sample] = []
        for key, payload in batch:
            data_key, source = keyexpr.source_of(key)
            if data_key and len(payload) == 4:
                freed += self._recovery.heartbeat(source, data_key, int.from_bytes(payload, "little"), now)
        self._go_on(freed)

    def _go_on(self, freed: list[Sample]) -> None:
        """Pass on what is in turn, ask for what is missing."""
        for key, count in self._recovery.misses():
            self._on_miss(key, count)
        if self._closed:
            return
        now = time.monotonic()
        for ask in self._recovery.asks(now):
            self._ask(ask)
        deadline = self._recovery.next_deadline()
        self._deadline.set(deadline if deadline < math.inf else None)
        if freed:
            self._arrivals.pass_on(self._on_batch, freed)

    def _ask(self, ask: Ask) -> None:
        dropped: list[bool] = []

        def replied(batch: Iterator[Numbered]) -> None:
            now = time.monotonic()
            if dropped:
                self._recovery.reply_dropped(ask)
            freed: list[Sample] = []
            for key, payload, _, number in batch:
                freed += self._recovery.reply(ask, number, (key, payload), now)
            self._go_on(freed)

        def ended(_: Iterator[Sample]) -> None:
            if dropped:
                self._recovery.reply_dropped(ask)
            self._go_on(self._recovery.ended(ask, time.monotonic()))

        self._get(f"{keyexpr.sources(ask.key, ask.source)}?_sn={ask.numbers}", replied, ended, dropped)

    def _get(self, selector: str, on_replies: OnNumbered, on_end: OnBatch, dropped: list[bool]) -> None:
        """``dropped`` gets an entry for each reply that there was no room for, before those that came after it."""
        arrivals = self._arrivals
        receive = arrivals.receiver(_ignore, on_replies)

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and not receive(reply.ok):
                dropped.append(True)

        try:
            self._session.get(
                selector,
                zenoh.handlers.Callback(on_reply, partial(arrivals.mark, on_end), indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                timeout=self.ASK_S,
            )
        except zenoh.ZError as error:  # the session is closed
            log.debug("get: %s", error)


def _ignore(_: Iterator[Sample]) -> None:
    """Replies that nobody has numbered."""
