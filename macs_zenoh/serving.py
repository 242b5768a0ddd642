"""Calls that an agent answers: Zenoh queries on keys of its id, declared anew when it gets another one.

Where one query brings calls for several agents (`together`), each is a call as any other to who answers it.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import NamedTuple

from .errors import MacsError, UsageError
from .handles import Handle
from .mesh import FAILED, Mesh, Subscription, now_s, said
from .protocol import together
from .protocol.agent_id import AgentId
from .protocol.guard import Gate
from .protocol.keyexpr import CALL, CALLS, type_name
from .protocol.limits import CALL_BYTES
from .protocol.messages import Metadata
from .protocol.wire import Layout, parse_frame

log = logging.getLogger("macs.agent")

WAITING = 1024
"""So many of them are being answered at one time where no gate says how many."""
TOGETHER_S = 0.1
"""After so long what has come of the calls of one query is answered: what has not, and goes on, is asked for again."""
LATER: together.CameTo = {together.FAILED: "it takes longer than others: ask again"}


class Call(NamedTuple):
    """What an agent that serves a verb is asked."""

    verb: str
    sender_type: str
    sender_id: int
    metadata: Metadata
    data: bytes


CallHandler = Callable[[Call], Awaitable[bytes]]
CallFirst = Callable[[Call], None]


class Served:
    """What one agent serves; ``me`` says who it is now, and ``gate`` judges who asks, before that can wait."""

    def __init__(self, layout: Layout, me: Callable[[], AgentId], gate: Gate | None) -> None:
        self._layout = layout
        self._me = me
        self._gate = gate
        self._declared: dict[Handle, list[tuple[Callable[[], Subscription], Subscription]]] = {}
        """What makes it anew, for another id, and what there is now."""
        self._answering: set[asyncio.Task[together.CameTo]] = set()

    def add(
        self,
        verb: str,
        handler: CallHandler,
        *,
        first: CallFirst | None,
        stand_in: bool,
        mesh: Mesh,
        most_bytes: int | None = None,
    ) -> Handle:
        """`Agent.serve`, by a session."""
        if most_bytes is None and first is not None:
            most_bytes = CALL_BYTES  # what is done at once is done where all are read

        async def answer(key: str, payload: bytes) -> bytes:
            return await handler(self._read(verb, key, payload))

        def declare() -> Subscription:
            at_once = None if first is None else lambda key, payload: first(self._read(verb, key, payload))
            me = self._me()
            own = CALL.every(type=me.type, id=me.id, verb=verb)
            return mesh.serve(own, answer, stand_in=stand_in, first=at_once, gate=self._gate, most_bytes=most_bytes)

        def declare_together() -> Subscription:
            def begin(key: str, payload: bytes) -> Awaitable[bytes]:
                return self._begin(verb, handler, key, payload)

            me = self._me()
            of_blocks = CALLS.every(type=me.type, id=me.id, verb=verb)
            return mesh.serve(of_blocks, begin, gate=self._gate, most_bytes=CALL_BYTES, in_order=True)

        kinds = [declare]
        if verb in together.VERBS and first is None and not stand_in:
            kinds.append(declare_together)
        handle = Handle(lambda: self._end(handle))
        self._declared[handle] = [(kind, kind()) for kind in kinds]
        return handle

    def renew(self) -> None:
        """The agent has another id."""
        for each in self._declared.values():
            for declare, declared in each:
                declared.become(declare())

    def close(self) -> None:
        """Serve nothing any more."""
        for handle in reversed(list(self._declared)):
            handle.close()
        for answering in self._answering:
            answering.cancel()

    def _end(self, handle: Handle) -> None:
        for _, declared in self._declared.pop(handle):
            declared.close()

    def _begin(self, verb: str, handler: CallHandler, key: str, payload: bytes) -> Awaitable[bytes]:
        """Answer calls of several agents, each by itself: from now on, so that what one of them asks later is not done
        before."""
        try:
            calls = together.read_calls(key, payload, self._layout)
        except MacsError as error:
            return _fail(error)
        me, now = self._me(), now_s()
        answers: list[asyncio.Task[together.CameTo] | None] = []
        for one in calls:
            sender = {"from_type": one.sender.type, "from_id": one.sender.id}
            single = CALL.of(type=me.type, id=me.id, verb=verb, **sender)  # it may ask as much as if it did by itself
            gate = self._gate
            if len(self._answering) >= WAITING if gate is None else not gate.admits(single, one.size, False, now):
                answers.append(None)
                continue
            call = Call(verb, type_name(one.sender.type), one.sender.id, one.metadata, one.data)
            answers.append(answer := asyncio.create_task(_answer(handler, call)))
            self._answering.add(answer)
            answer.add_done_callback(self._answering.discard)
        return _told(answers)

    def _read(self, verb: str, key: str, payload: bytes) -> Call:
        fields = CALL.parse(key)
        if fields is None:
            raise UsageError(f"{key} is not a call")
        frame = parse_frame(payload, self._layout)
        metadata = Metadata.decode(frame.metadata) if frame.metadata else Metadata()
        metadata = metadata.sent_by(*fields.sender)
        return Call(verb, type_name(fields.from_type), fields.from_id, metadata, bytes(frame.body))


async def _answer(handler: CallHandler, call: Call) -> together.CameTo:
    """What comes of a call among others."""
    try:
        await handler(call)
    except MacsError as error:
        return said(error)
    except Exception:
        log.exception("call %s of %s/%d failed", call.verb, call.sender_type, call.sender_id)
        return FAILED
    return None


async def _told(answers: list[asyncio.Task[together.CameTo] | None]) -> bytes:
    """What has come of calls until it is answered; None: one was not admitted."""
    if admitted := [answer for answer in answers if answer is not None]:
        await asyncio.wait(admitted, timeout=TOGETHER_S)
    ended = [answer.result() if answer is not None and answer.done() else LATER for answer in answers]
    return together.write_answers(ended)


async def _fail(error: MacsError) -> bytes:
    raise error
