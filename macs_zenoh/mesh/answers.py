"""Answers that are looked for, since nobody waits for one so much that it must wake the loop. Asyncio.

To be called for each answer, a thread of Zenoh's takes Python's lock from the loop, which then waits to have it back,
and is woken for what one look finds together with others. What comes behind over the same link, as a stop may, waits
as well. So answers wait in Zenoh.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import msgspec
import zenoh

from macs_zenoh.errors import CallTimeout, HeldByAnother, MacsError, NotServed, Refused, Unreachable
from macs_zenoh.protocol.limits import REASON_CHARACTERS, REQUEST_BYTES

log = logging.getLogger("macs.mesh")

FIRST_S, LAST_S = 0.002, 0.02
"""Pause before a look: at first, and when those before it have found nothing."""
TURN_S = 0.003
"""After so long of handling answers everything else has its turn."""
UNANSWERED = 4
"""Who is asked answers nearly in order: behind so many unanswered questions a look goes no further, unless the one
before it has found nothing anywhere, or none has for ``LAST_S``."""
KEPT = 1024
"""So many answers to one question wait before Zenoh's thread does: the first counts, and then others are let go. They
are taken nevertheless, until there can be no more: Zenoh logs each that nobody takes."""

WAITING = 1 << 16
"""The same where all of them count."""

AT_ONCE = 500
"""So many of those are taken without a break."""

OnAnswer = Callable[[bytes | MacsError], None]
"""Hears the answer to a call, or why there is none, on the loop."""

HOLDER = re.compile(r"([0-9]{1,3})/([0-9]{1,5})")
"""Who has what was refused: agent type and id."""


async def all_answers(ask: Callable[[zenoh.handlers.FifoChannel[zenoh.Reply]], Any]) -> list[zenoh.Sample]:
    """Whatever a question is answered with, but for refusals: ``ask`` puts it, and gives back Zenoh's handler."""
    replies: zenoh.handlers.Handler[zenoh.Reply] = ask(zenoh.handlers.FifoChannel(WAITING))
    answers: list[zenoh.Sample] = []
    pause_s = FIRST_S
    while True:
        try:
            for _ in range(AT_ONCE):
                reply = replies.try_recv()
                if reply is None:
                    break
                if reply.ok is not None:
                    answers.append(reply.ok)
                pause_s = FIRST_S / 2
        except zenoh.ZError:  # all have answered
            return answers
        await asyncio.sleep(pause_s)
        pause_s = min(2 * pause_s, LAST_S)


class _Question(NamedTuple):
    key: str
    timeout_s: float
    replies: zenoh.handlers.Handler[zenoh.Reply]
    on_answer: OnAnswer

    def answer(self) -> bytes | MacsError | None:
        """The first one, if there is one yet, or why there will be none."""
        try:
            reply = self.replies.try_recv()
        except zenoh.ZError:  # all have answered, and that was nobody
            return NotServed(self.key)
        if reply is None:
            return None
        if (ok := reply.ok) is not None:
            return ok.payload.to_bytes()
        return problem(self.key, reply.err.payload.to_bytes() if reply.err is not None else b"", self.timeout_s)

    def rest(self) -> int | None:
        """Let go what else was answered: how much that was, None when there can be no more."""
        try:
            for count in range(KEPT):
                if self.replies.try_recv() is None:
                    return count
        except zenoh.ZError:
            return None
        return KEPT


class Answers:
    """Those of one session."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._open: dict[Hashable, list[_Question]] = {}
        """By who is asked: in the order in which they were."""
        self._answered: deque[_Question] = deque()
        """Those to which more answers may come."""
        self._pause_s = FIRST_S
        self._thorough_s = 0.0
        """When all were looked at last."""
        self._looking: asyncio.TimerHandle | None = None

    def close(self) -> None:
        """Look no more."""
        if self._looking is not None:
            self._looking.cancel()

    def expect(
        self,
        of: Hashable,
        key: str,
        timeout_s: float,
        replies: zenoh.handlers.Handler[zenoh.Reply],
        on_answer: OnAnswer,
    ) -> None:
        """Somebody was asked: ``on_answer`` hears of the first answer, later and on the loop."""
        self._open.setdefault(of, []).append(_Question(key, timeout_s, replies, on_answer))
        if self._looking is None or self._pause_s > FIRST_S:
            self._look_after(FIRST_S)

    def _look_after(self, pause_s: float) -> None:
        if self._looking is not None:
            self._looking.cancel()
        self._pause_s = pause_s
        self._looking = self._loop.call_later(pause_s, self._look)

    def _look(self) -> None:
        self._looking = None
        now = time.monotonic()
        until = now + TURN_S
        thorough = self._pause_s > FIRST_S or now > self._thorough_s + LAST_S
        if thorough:
            self._thorough_s = now
        found = self._let_go(now + TURN_S / 2)
        for of in list(self._open):
            for on_answer, answer in self._take(of, thorough=thorough):
                found = True
                try:
                    on_answer(answer)
                except Exception:  # it must not cost others their answers
                    log.exception("an answer was not handled")
            if time.monotonic() > until:
                break
        if (self._open or self._answered) and (self._looking is None or self._pause_s > FIRST_S):
            self._look_after(FIRST_S if found else min(2 * self._pause_s, LAST_S))

    def _let_go(self, until: float) -> bool:
        """What was answered behind a first answer, as much as there is time for: who answers and does not end it can
        have thousands of these open. Whether there was anything."""
        found = False
        for _ in range(len(self._answered)):
            question = self._answered.popleft()
            rest = question.rest()
            if rest is not None:
                self._answered.append(question)
            found = found or bool(rest)
            if time.monotonic() > until:
                break
        return found

    def _take(self, of: Hashable, *, thorough: bool) -> list[tuple[OnAnswer, bytes | MacsError]]:
        """The answers that there are of one; who is looked at again behind all others."""
        asked, looked = self._open.pop(of, []), 0
        unanswered: list[_Question] = []
        answered: list[tuple[OnAnswer, bytes | MacsError]] = []
        for question in asked:
            looked += 1
            answer = question.answer()
            if answer is not None:
                answered.append((question.on_answer, answer))
                if question.rest() is not None:
                    self._answered.append(question)
                continue
            unanswered.append(question)
            if len(unanswered) == UNANSWERED and not thorough:
                break
        if left := unanswered + asked[looked:]:
            self._open[of] = left
        return answered


def problem(key: str, payload: bytes, timeout_s: float) -> MacsError:
    """What an error reply means: ours is JSON, Zenoh's own is the word ``Timeout``."""
    if payload == b"Timeout":
        return CallTimeout(key, timeout_s)
    try:
        answer = msgspec.json.decode(payload[:REQUEST_BYTES], type=dict[str, str])
    except (msgspec.DecodeError, UnicodeDecodeError):
        return Unreachable(key, payload[:200].decode(errors="replace"))
    return understood(key, answer)


def said(error: MacsError) -> dict[str, str]:
    """What is answered to a call instead of what was asked."""
    if isinstance(error, HeldByAnother):
        return {"refused": error.reason, "holder": "{}/{}".format(*error.holder)}
    return {"refused": error.reason if isinstance(error, Refused) else str(error)}


FAILED = {"failed": "internal error, see the log there"}
"""The same where the fault is ours."""


def understood(key: str, answer: dict[str, str]) -> MacsError:
    """What that means to who asked."""
    if "refused" in answer:
        holder = HOLDER.fullmatch(answer.get("holder", ""))
        if holder is None:
            return Refused(answer["refused"][:REASON_CHARACTERS])
        return HeldByAnother(answer["refused"][:REASON_CHARACTERS], (int(holder[1]), int(holder[2])))
    return Unreachable(key, answer.get("failed", "unknown failure")[:REASON_CHARACTERS])
