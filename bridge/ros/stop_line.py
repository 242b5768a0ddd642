"""A Zenoh session of a robot's own for its emergency stop.

A session has one link, one queue for it at the router, and one thread that reads it. Whatever anybody puts to the
robot is in front of a stop there. So the verb ``stop`` is served by a session that has nothing else to do: it
subscribes to nothing, and nothing is sent to it but stops. The robot's main session serves the verb as long as this
one cannot.
"""

from __future__ import annotations

import asyncio
import logging
import uuid
from collections.abc import Callable

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError
from macs_zenoh.mesh import Mesh
from macs_zenoh.sections import changed

log = logging.getLogger("macs.ros")


class StopLine:
    """That session. ``serve`` declares what it is for; until `close` it is kept, through outages of its router."""

    def __init__(self, settings: MeshSettings, serve: Callable[[Mesh], object]) -> None:
        self._settings = apart(settings)
        self._serve = serve
        self.is_open = False
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def _run(self) -> None:
        try:
            async with await Mesh.open(self._settings, on_waiting=lambda target: None) as mesh:
                self._serve(mesh)
                self.is_open = True
                await asyncio.Event().wait()
        except MacsError as error:
            log.warning("the emergency stop shares the session of everything else: %s", error)
        finally:
            self.is_open = False

    async def close(self) -> None:
        """End it."""
        self._task.cancel()
        await asyncio.wait([self._task])


def apart(settings: MeshSettings) -> MeshSettings:
    """The settings of a second session beside one with these: routers let nobody in who has another's Zenoh id."""
    others = [override for override in settings.overrides if not override.lstrip().startswith("id:")]
    if len(others) == len(settings.overrides) and settings.config_file is None:
        return settings  # Zenoh chooses the id
    return changed(settings, overrides=[*others, f'id:"a{uuid.uuid4().hex[1:]}"'])
