"""What is asked once for all who want to know: ten pages cost a robot what one does."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

from macs_zenoh.errors import MacsError

T = TypeVar("T")


class Fresh(Generic[T]):
    """An answer that is good for a while, and is asked for again by whoever wants it after that."""

    def __init__(self, ask: Callable[[], Awaitable[T]], good_s: float) -> None:
        """``ask`` may raise MacsError: who waits gets it, and the next one asks again after ``good_s``."""
        self._good_s = good_s
        self.wanted_at = 0.0
        """When somebody last wanted it, by the loop's clock."""
        self._ask = ask
        self._answered_at = -float("inf")
        self._answer: T | None = None
        self._problem: MacsError | None = None
        self._asking: asyncio.Task[None] | None = None

    @property
    def asking(self) -> bool:
        """Whether somebody may wait for an answer."""
        return self._asking is not None

    def last(self, good_s: float | None = None) -> T | None:
        """What is known now. An old answer (``good_s``) is given as well, and a new one asked for."""
        self._look(good_s)
        return self._answer

    async def now(self) -> T:
        """An answer that is good. Raises what asking raised."""
        self._look()
        if self._asking is not None:
            await asyncio.shield(self._asking)
        if self._problem is not None:
            raise self._problem.with_traceback(None)  # each raising would lengthen it
        assert self._answer is not None
        return self._answer

    def close(self) -> None:
        """Ask no more."""
        if self._asking is not None:
            self._asking.cancel()

    def _look(self, good_s: float | None = None) -> None:
        good_s = self._good_s if good_s is None else good_s
        loop = asyncio.get_running_loop()
        self.wanted_at = loop.time()
        if self._asking is None and loop.time() - self._answered_at >= good_s:
            self._asking = loop.create_task(self._renew())

    async def _renew(self) -> None:
        try:
            self._answer = await self._ask()
            self._problem = None
        except MacsError as error:
            self._answer, self._problem = None, error.with_traceback(None)  # which keeps all that was at work
            error.__cause__ = error.__context__ = None
        finally:
            self._answered_at = asyncio.get_running_loop().time()
            self._asking = None
