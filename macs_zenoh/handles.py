"""What is asked for until it is closed: each callback, and whatever is served, has a handle. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Generic, TypeVar

T = TypeVar("T")


class Handle:
    """Ends what it stands for, by `close` or at the end of a ``with`` block. It need not be kept."""

    def __init__(self, end: Callable[[], object]) -> None:
        self._end: Callable[[], object] | None = end

    @property
    def is_open(self) -> bool:
        """Whether it has not been closed."""
        return self._end is not None

    def close(self) -> None:
        """End it. Closing twice is allowed."""
        end, self._end = self._end, None
        if end is not None:
            end()

    def __enter__(self) -> Handle:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Callbacks(Generic[T]):
    """Who is told of something, in the order in which they asked. One that has been closed meanwhile is left out."""

    def __init__(self) -> None:
        self._told: dict[Handle, T] = {}

    def add(self, callback: T) -> Handle:
        """Tell it as well, until the handle is closed."""
        handle = Handle(lambda: self._told.pop(handle, None))
        self._told[handle] = callback
        return handle

    def __iter__(self) -> Iterator[T]:
        return (callback for handle, callback in list(self._told.items()) if handle.is_open)

    def __bool__(self) -> bool:
        return bool(self._told)
