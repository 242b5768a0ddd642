"""Calls: Zenoh queries that somebody answers, or refuses with a reason."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Awaitable, Callable, Hashable
from contextlib import suppress
from functools import partial
from typing import Any

import msgspec
import zenoh

from macs_zenoh.errors import MacsError, NotServed, OutOfRange, Refused
from macs_zenoh.protocol.guard import Admits
from macs_zenoh.protocol.limits import ASKED_BYTES, CALL_BYTES

from .answers import FAILED, KEPT, Answers, OnAnswer, all_answers, problem, said
from .arrivals import Arrivals, now_s
from .copies import copied
from .declared import Handler, Payload, Subscription, Traffic
from .outgoing import Outgoing
from .panics import end_if_panic
from .threads import keep_attached

log = logging.getLogger("macs.mesh")

WAITING = 1024
"""So many calls that no gate admits may wait to be looked at; what is more has no answer."""


class _Asked:
    """A query on its way, and who waits for its answer: for the first one, as several may serve a key."""

    __slots__ = ("_answered", "_from_thread", "_key", "_on_answer", "_timeout_s")

    def __init__(self, key: str, timeout_s: float, on_answer: OnAnswer, from_thread: Callable[..., None]) -> None:
        self._key = key
        self._timeout_s = timeout_s
        self._on_answer: OnAnswer | None = on_answer
        self._from_thread = from_thread
        self._answered = False

    def reply(self, reply: zenoh.Reply) -> None:
        """In a thread of Zenoh's."""
        keep_attached()
        self._answered = True
        if (ok := reply.ok) is not None:
            self._from_thread(self._settle, ok.payload.to_bytes())
        elif reply.err is not None:
            self._from_thread(self._settle, problem(self._key, reply.err.payload.to_bytes(), self._timeout_s))

    def end(self) -> None:
        """All have answered, in a thread of Zenoh's."""
        if not self._answered:
            self._from_thread(self._settle, NotServed(self._key))

    def _settle(self, answer: bytes | MacsError) -> None:
        """On the loop."""
        on_answer, self._on_answer = self._on_answer, None
        if on_answer is not None:
            on_answer(answer)


class Calls:
    """Those of one session: what it asks, and what it serves."""

    def __init__(
        self,
        session: zenoh.Session,
        arrivals: Arrivals,
        outgoing: Outgoing,
        from_thread: Callable[..., None],
    ) -> None:
        self._session = session
        self._session_get = session.get  # looked up once
        self._loop = asyncio.get_running_loop()
        self._arrivals = arrivals
        self._outgoing = outgoing
        self._from_thread = from_thread
        self._tasks: set[asyncio.Task[None]] = set()
        self._asked_bytes = 0
        """Of large calls that wait or are being answered."""
        self._lock = threading.Lock()
        self._answers = Answers()

    def close(self) -> None:
        """Answer nothing any more, and hear of no answer."""
        self._answers.close()
        for task in self._tasks:
            task.cancel()

    async def query(self, key: str, payload: Payload, *, timeout_s: float, traffic: Traffic) -> bytes:
        """`Mesh.query`."""
        done: asyncio.Future[bytes] = self._loop.create_future()

        def settle(answer: bytes | MacsError) -> None:
            if done.done():
                return
            if isinstance(answer, MacsError):
                done.set_exception(answer)
            else:
                done.set_result(answer)

        asked = _Asked(key, timeout_s, settle, self._from_thread)
        answer = zenoh.handlers.Callback(asked.reply, asked.end, indirect=False)
        self._get(key, answer, payload, timeout_s, traffic)
        return await done

    def ask(
        self, key: str, payload: Payload, on_answer: OnAnswer, *, of: Hashable, timeout_s: float, traffic: Traffic
    ) -> None:
        """`Mesh.ask`."""
        replies = self._get(key, zenoh.handlers.FifoChannel(KEPT), payload, timeout_s, traffic)
        self._answers.expect(of, key, timeout_s, replies, on_answer)

    def _get(self, key: str, answers: Any, payload: Payload, timeout_s: float, traffic: Traffic) -> Any:
        shape = self._outgoing.policer.of(key)
        if shape is not None and (overrun := shape.too_large(len(payload))) is not None:
            raise OutOfRange(f"size of {key}", len(payload), 0, int(overrun.limit))
        priority, congestion, express = self._outgoing.way(key, traffic)
        return self._session_get(
            key,
            answers,
            payload=payload,
            timeout=timeout_s,
            priority=priority,
            congestion_control=congestion,
            express=express,
        )

    async def ask_all(self, key: str, *, timeout_s: float) -> list[tuple[str, bytes]]:
        """`Mesh.ask_all`."""
        answers = await all_answers(
            lambda replies: self._session.get(key, replies, target=zenoh.QueryTarget.ALL, timeout=timeout_s)
        )
        return [(str(answer.key_expr), answer.payload.to_bytes()) for answer in answers]

    def serve(
        self,
        key: str,
        handler: Handler,
        *,
        stand_in: bool,
        first: Callable[[str, bytes], None] | None,
        gate: Admits | None,
        most_bytes: int | None,
        in_order: bool,
    ) -> Subscription:
        """`Mesh.serve`."""

        async def answer(query: zenoh.Query, problem: Refused | None, begun: Awaitable[bytes | None] | None) -> None:
            self._arrivals.asked.popleft()
            with query:
                name = str(query.key_expr)
                try:
                    if problem is not None:
                        raise problem
                    reply = await (begun if begun is not None else handler(name, _payload(query)))
                    if reply is not None:
                        query.reply(query.key_expr, reply)
                except MacsError as error:
                    query.reply_err(msgspec.json.encode(said(error)))
                except Exception:
                    log.exception("call %s failed", name)
                    query.reply_err(msgspec.json.encode(FAILED))
                except BaseException as error:
                    end_if_panic(error)
                    raise

        def spawn(query: zenoh.Query, problem: Refused | None, counted: int) -> None:
            begun = None
            if in_order and problem is None:
                begun = handler(str(query.key_expr), _payload(query))
            task = self._loop.create_task(answer(query, problem, begun))
            self._tasks.add(task)
            task.add_done_callback(partial(self._answered, counted))

        def on_query(query: zenoh.Query) -> None:
            keep_attached()
            size = len(query.payload) if query.payload is not None else 0
            if most_bytes is not None and size > most_bytes:
                self._refuse(query, f"it brings {size} bytes, at most {most_bytes} are read", size, gate, key)
                return
            problem = _tried(first, query) if first is not None else None
            counted = size if size > CALL_BYTES else 0
            if not self._admits(query, size, counted, gate, key):
                query.drop()  # type: ignore[no-untyped-call]
                return
            self._arrivals.asked.append(query)
            self._from_thread(spawn, query, problem, counted)

        answering = zenoh.handlers.Callback(on_query, indirect=False)
        # Zenoh asks one that is complete if there is any, else all
        return Subscription(self._session.declare_queryable(key, answering, complete=not stand_in))

    def _refuse(self, query: zenoh.Query, reason: str, size: int, gate: Admits | None, key: str) -> None:
        """Answer a call that is not read, and let it go with all that it brings. In a thread of Zenoh's."""
        self._outgoing.drops.note("too_large", key, reason)
        if gate is None or gate.admits(str(query.key_expr), size, False, now_s()):
            with suppress(zenoh.ZError):  # the session is closed
                query.reply_err(msgspec.json.encode({"refused": reason}))
        query.drop()  # type: ignore[no-untyped-call]

    def _admits(self, query: zenoh.Query, size: int, counted: int, gate: Admits | None, key: str) -> bool:
        """Whether a call may wait, with all that it brings, of which so much counts: small ones are judged by their
        number, so that no large one is in their way, nor they in its. In a thread of Zenoh's."""
        if gate is not None and not gate.admits(str(query.key_expr), size, False, now_s()):
            return False
        with self._lock:
            full = counted > 0 and self._asked_bytes > 0 and self._asked_bytes + counted > ASKED_BYTES
            full = full or (gate is None and len(self._arrivals.asked) >= WAITING)
            self._asked_bytes += 0 if full else counted
        if full:
            self._outgoing.drops.note("flooded", key, "more is asked than can be answered")
        return not full

    def _answered(self, counted: int, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        with self._lock:
            self._asked_bytes -= counted


def _payload(query: zenoh.Query) -> bytes:
    return copied(query.payload) if query.payload is not None else b""


def _tried(first: Callable[[str, bytes], None], query: zenoh.Query) -> Refused | None:
    """Why what had to be done at once was not."""
    try:
        first(str(query.key_expr), _payload(query))
    except Refused as refusal:
        return refusal
    except MacsError as error:
        return Refused(str(error))
    except Exception:
        log.exception("call %s failed", query.key_expr)
        return Refused("internal error, see the log there")
    return None
