"""Calls that an agent answers: Zenoh queries on keys of its id, declared anew when it gets another one."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import NamedTuple

from .errors import UsageError
from .handles import Handle
from .mesh import Mesh, Subscription
from .protocol.agent_id import AgentId
from .protocol.guard import Gate
from .protocol.keyexpr import CALL, type_name
from .protocol.limits import CALL_BYTES
from .protocol.messages import Metadata
from .protocol.wire import Layout, parse_frame


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
        self._declared: dict[Handle, tuple[Callable[[], Subscription], Subscription]] = {}
        """What makes it anew, for another id, and what there is now."""

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

        declared = declare()
        handle = Handle(lambda: self._end(handle))
        self._declared[handle] = (declare, declared)
        return handle

    def renew(self) -> None:
        """The agent has another id."""
        for declare, declared in self._declared.values():
            declared.become(declare())

    def close(self) -> None:
        """Serve nothing any more."""
        for handle in reversed(list(self._declared)):
            handle.close()

    def _end(self, handle: Handle) -> None:
        _, declared = self._declared.pop(handle)
        declared.close()

    def _read(self, verb: str, key: str, payload: bytes) -> Call:
        fields = CALL.parse(key)
        if fields is None:
            raise UsageError(f"{key} is not a call")
        frame = parse_frame(payload, self._layout)
        metadata = Metadata.decode(frame.metadata) if frame.metadata else Metadata()
        metadata = metadata.sent_by(*fields.sender)
        return Call(verb, type_name(fields.from_type), fields.from_id, metadata, bytes(frame.body))
