"""The gateway's place on the mesh: one name, the types that its modules take, and what becomes of each message.

Everything here runs on the event loop, except `MeshLink.send`. A gateway may be active long before a router answers:
until then its messages are answered with `Outcome.NO_ROUTER`, or wait as long as their type's deadline says.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable
from contextlib import AsyncExitStack, suppress

import macs_zenoh
from bridge.settings import Settings
from macs_zenoh.awareness import Awareness, Received, Registration
from macs_zenoh.errors import MacsError
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.named import Outcome

log = logging.getLogger("macs.awareness")

OnOutcome = Callable[[str, str, Outcome], None]
OnRefused = Callable[[str, str, MacsError], None]


class MeshLink:
    """One gateway on the mesh.

    ``on_message`` gets what arrives, ``on_outcome(receiver, type, outcome)`` what is known of each message sent,
    ``on_refused(receiver, type, error)`` why one that was to wait cannot be sent; ``on_change`` is told that another
    agent came, left or takes other types.

    ``counters`` are those of `Awareness`, over all activations, and ``waiting_full``.
    """

    WAITING = 1024
    """Messages that may wait for their receiver, until their deadlines."""
    WAITING_BYTES = 64 << 20

    def __init__(
        self,
        settings: Settings,
        on_message: Callable[[Received], None],
        on_outcome: OnOutcome,
        on_refused: OnRefused,
        on_change: Callable[[], None],
    ) -> None:
        self.settings = settings
        self.awareness: Awareness | None = None
        self._on_message = on_message
        self._on_outcome = on_outcome
        self._on_refused = on_refused
        self._on_change = on_change
        self._loop = asyncio.get_running_loop()
        self._mesh: asyncio.Future[Mesh] = asyncio.get_running_loop().create_future()
        self._agent_id = 0
        self._before: Counter[str] = Counter()
        self._wanted: dict[str, Registration | None] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._waiting_bytes = 0

    async def run(self, on_waiting: Callable[[str], None] | None = None) -> None:
        """Be on the mesh until cancelled. Raises what `macs_zenoh.join` raises."""
        wanted = self.settings.awareness
        async with AsyncExitStack() as stack:
            try:
                if wanted.beside and wanted.id is not None:
                    mesh = await Mesh.open(self.settings.mesh, traffic=self.settings.traffic, on_waiting=on_waiting)
                    await stack.enter_async_context(mesh)
                    self._agent_id = wanted.id
                    self._mesh.set_result(mesh)
                else:
                    agent = await stack.enter_async_context(
                        macs_zenoh.join(
                            "ros",
                            id=wanted.id,
                            settings=self.settings.mesh,
                            traffic=self.settings.traffic,
                            on_waiting=on_waiting,
                        )
                    )
                    self._agent_id = agent.id
                    agent.on_id(self._id_changed)
                    self._mesh.set_result(agent.mesh)
            except MacsError as error:
                self._mesh.set_exception(error)
                raise
            try:
                await asyncio.Event().wait()
            finally:
                self.deactivate()
                for task in self._tasks:
                    task.cancel()

    # -- active or not -------------------------------------------------------------------------------------------

    async def activate(self, name: str) -> None:
        """Take the name, as soon as there is a router. Raises UsageError when it cannot be had."""
        mesh = await asyncio.shield(self._mesh)
        settings = self.settings.awareness
        awareness = Awareness(
            mesh,
            name,
            agent_type=ROS,
            agent_id=self._agent_id,
            max_hz=settings.max_hz,
            cache=settings.cache,
            max_bytes=settings.max_bytes,
        )
        try:
            await awareness.start()
        except BaseException:
            awareness.close()
            raise
        self.awareness = awareness
        awareness.on_change(lambda _name: self._on_change())
        for message_type in self._wanted:
            self._register(message_type)
        self._on_change()

    def _id_changed(self, _old: int, new: int) -> None:
        self._agent_id = new
        if self.awareness is not None:
            self.awareness.change_id(new)

    def deactivate(self) -> None:
        """Give the name up."""
        if self.awareness is not None:
            self._before += self.awareness.counters
            self.awareness.close()
            self.awareness = None
        self._wanted = dict.fromkeys(self._wanted)

    @property
    def mesh(self) -> Mesh | None:
        """The session, once there is one."""
        opened = self._mesh
        return opened.result() if opened.done() and not opened.cancelled() and opened.exception() is None else None

    @property
    def counters(self) -> Counter[str]:
        """What was sent and what arrived, by name."""
        before, awareness = Counter(dict(self._before)), self.awareness  # dict: at once, other threads count too
        return before + Counter(dict(awareness.counters)) if awareness is not None else before

    # -- types ---------------------------------------------------------------------------------------------------

    def want(self, message_type: str) -> None:
        """A module takes this type."""
        if message_type not in self._wanted:
            self._wanted[message_type] = None
            self._register(message_type)

    def unwant(self, message_type: str) -> None:
        """No module takes it any more."""
        registration = self._wanted.pop(message_type, None)
        if registration is not None:
            registration.close()

    def _register(self, message_type: str) -> None:
        if self.awareness is not None:
            self._wanted[message_type] = self.awareness.register(
                message_type, self._on_message, last_value=message_type in self.settings.awareness.last_values
            )

    # -- messages ------------------------------------------------------------------------------------------------

    def knows(self, name: str) -> bool:
        """Whether an agent of this name is on the mesh."""
        return self.awareness is not None and name in self.awareness.names

    def send(self, receiver: str, message_type: str, data: bytes) -> None:
        """Send a module's message; ``on_outcome`` is told, at once or by the deadline. From any thread.

        Raises UsageError for words and sizes that cannot be sent.
        """
        deadline_s = self.settings.awareness.deadlines_s.get(message_type)
        awareness = self.awareness
        if receiver and deadline_s is not None:
            with suppress(RuntimeError):  # the loop is closed: the program is ending
                self._loop.call_soon_threadsafe(self._deliver_later, receiver, message_type, data, deadline_s)
        elif awareness is None:
            self._note(receiver, message_type, Outcome.NO_ROUTER)
        else:
            self._on_outcome(receiver, message_type, awareness.send(receiver, message_type, data))

    def _deliver_later(self, receiver: str, message_type: str, data: bytes, deadline_s: float) -> None:
        if len(self._tasks) >= self.WAITING or self._waiting_bytes + len(data) > max(self.WAITING_BYTES, len(data)):
            self._before["waiting_full"] += 1
            self._on_outcome(receiver, message_type, Outcome.LATE)
            return
        self._waiting_bytes += len(data)
        task = asyncio.get_running_loop().create_task(self._deliver(receiver, message_type, data, deadline_s))
        self._tasks.add(task)

        def done(task: asyncio.Task[None]) -> None:
            self._tasks.discard(task)
            self._waiting_bytes -= len(data)

        task.add_done_callback(done)

    async def _deliver(self, receiver: str, message_type: str, data: bytes, deadline_s: float) -> None:
        deadline = asyncio.get_running_loop().time() + deadline_s
        while self.awareness is None:
            left = deadline - asyncio.get_running_loop().time()
            if left <= 0:
                self._note(receiver, message_type, Outcome.NO_ROUTER)
                return
            await asyncio.sleep(min(left, 0.05))
        left = max(0.001, deadline - asyncio.get_running_loop().time())
        try:
            outcome = await self.awareness.deliver(receiver, message_type, data, deadline_s=left)
        except MacsError as error:
            self._on_refused(receiver, message_type, error)
        else:
            self._on_outcome(receiver, message_type, outcome)

    def _note(self, receiver: str, message_type: str, outcome: Outcome) -> None:
        self._before[outcome.counter] += 1
        self._on_outcome(receiver, message_type, outcome)

    def others(self) -> dict[str, dict[str, object]]:
        """Who can be reached, as ``{"drone1": {"type": "ros", "id": 7, "takes": ["planning"]}}``."""
        if self.awareness is None:
            return {}
        names = self.awareness.names
        return {
            agent.name: {"type": agent.type_name, "id": agent.id, "takes": names.types(agent.name)}
            for agent in self.awareness.others()
        }
