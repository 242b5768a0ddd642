"""A Zenoh session of a robot's own for its emergency stop.

A session has one link, one queue for it at the router, and one thread that reads it. Whatever anybody puts to the
robot is in front of a stop there. So the verb ``stop`` is served by a session that has nothing else to do: it
subscribes to nothing, and nothing is sent to it but stops. The robot's main session serves the verb as long as this
one cannot.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError
from macs_zenoh.handles import Handle
from macs_zenoh.locked_out import apart, locked_out
from macs_zenoh.mesh import Mesh

log = logging.getLogger("macs.ros")

AGAIN_S = 5.0
"""Until a session that could not be had, or has failed, is tried again."""


class StopLine:
    """That session. ``serve`` declares what it is for; until `close` it is kept, through outages of its router."""

    def __init__(self, settings: MeshSettings, serve: Callable[[Mesh], Handle]) -> None:
        self._settings = settings
        self._serve = serve
        self.is_open = False
        self._problem = ""
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def _run(self) -> None:
        while True:
            try:
                await self._once()
            except MacsError as error:
                self._tell(str(error))
                await asyncio.sleep(AGAIN_S)
            except Exception as error:
                if self._tell(repr(error)):
                    log.exception("serving the emergency stop in a session of its own failed")
                await asyncio.sleep(AGAIN_S)

    async def _once(self) -> None:
        """Serve in one session, until somebody else has taken its Zenoh id."""
        async with await Mesh.open(apart(self._settings), on_waiting=lambda target: None) as mesh:
            serving = self._serve(mesh)
            self.is_open, self._problem = True, ""
            try:
                await locked_out(mesh, any_id=True)
            finally:
                self.is_open = False
                serving.close()

    def _tell(self, problem: str) -> bool:
        """Say what is wrong; whether it is news."""
        if problem == self._problem:
            return False
        self._problem = problem
        log.warning("the emergency stop shares the session of everything else: %s", problem)
        return True

    async def close(self) -> None:
        """End it."""
        self._task.cancel()
        await asyncio.wait([self._task])
