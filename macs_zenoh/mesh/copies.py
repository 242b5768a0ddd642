"""Large payloads, from Zenoh's memory to Python's: nobody waits for the kernel meanwhile.

Zenoh's binding copies while it holds Python's lock. In a program whose C library maps each large piece by itself
(`hold_heap`) the kernel makes each of its pages during the copy: of 31 MiB that took 18 of 23 ms, and on busy cores
everybody waited for 30 to 70. So the place is made ready before, without the lock; then the copy takes 6.
"""

from __future__ import annotations

import ctypes
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Protocol

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_MADV_HUGEPAGE, _MADV_POPULATE_WRITE = 14, 23
"""The kernel may not know them: then it does what it always did."""
MOST_BYTES = 32 << 20
"""What is larger glibc always maps by itself."""
BESIDES = 64 << 10
"""So much larger is the place than what is copied to it: it has a head, and ends with a page."""
PAGE = 4096
KEPT_BYTES = 128 << 10
"""Of a piece of each thread's heap that is freed to have the C library give back that heap's end: `malloc_trim` gives
back what is free in between, and the end of the main heap alone."""
CALM_S = 0.2
"""So long after the last large copy its place is given back: whoever frees one would do so with Python's lock."""


class Copied(Protocol):
    """A payload of Zenoh's."""

    def __len__(self) -> int: ...

    def to_bytes(self) -> bytes:
        """A copy."""


class _Heap:
    """The C library's, held to these numbers. ``mapped_bytes``: so much and more is mapped by itself.
    ``spare_bytes``: so much is kept at its end."""

    def __init__(self, mapped_bytes: int, spare_bytes: int) -> None:
        self.mapped_bytes = mapped_bytes
        self._spare_bytes = spare_bytes
        with_lock, without = ctypes.PyDLL(None), ctypes.CDLL(None)  # Python's, which is not given up for a moment
        self._set, self._take, self._free = with_lock.mallopt, with_lock.malloc, with_lock.free
        self._take.restype, self._take.argtypes = ctypes.c_void_p, (ctypes.c_size_t,)
        self._free.argtypes = (ctypes.c_void_p,)
        self._advise = without.madvise
        self._advise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
        self._give = without.free
        self._give.argtypes = (ctypes.c_void_p,)
        self._trim = without.malloc_trim
        self._trim.argtypes = (ctypes.c_size_t,)
        self._kept: dict[int, int] = {}
        """Such pieces by thread."""
        self._lock = threading.Lock()
        self._used_at = 0.0
        self._gives_back = False
        """Whether a thread waits until it is calm."""
        self._hold()

    @contextmanager
    def place(self, size: int) -> Iterator[None]:
        """Within it, this thread's next piece of so many bytes is ready to be written to."""
        with self._lock:
            try:
                self._keep()
                if self._set(_M_MMAP_THRESHOLD, MOST_BYTES) and self._set(_M_TRIM_THRESHOLD, 4 * MOST_BYTES):
                    self._make_ready(size + BESIDES)
                yield
            finally:
                self._hold()
                self._used_at = time.monotonic()
                self._give_back_later()

    def _give_back_later(self) -> None:
        if self._gives_back:
            return
        self._gives_back = True
        try:
            threading.Thread(target=self._give_back, name="macs-heap", daemon=True).start()
        except RuntimeError:  # there may be no more threads, or the interpreter ends: the next large copy tries again
            self._gives_back = False

    def _give_back(self) -> None:
        """Once nothing large has come for a while, let the kernel have what is free."""
        while self._gives_back:
            time.sleep(CALM_S)
            with self._lock:
                if time.monotonic() < self._used_at + CALM_S:
                    continue
                kept, self._kept = self._kept, {}
                self._set(_M_TRIM_THRESHOLD, KEPT_BYTES)
                for piece in kept.values():
                    self._give(piece)
                self._trim(0)
                self._hold()
                self._gives_back = False

    def _keep(self) -> None:
        thread = threading.get_ident()
        if thread not in self._kept and (piece := self._take(KEPT_BYTES)):
            self._kept[thread] = piece

    def _hold(self) -> None:
        self._set(_M_MMAP_THRESHOLD, self.mapped_bytes)
        self._set(_M_TRIM_THRESHOLD, self._spare_bytes)

    def _make_ready(self, size: int) -> None:
        piece = self._take(size)
        if piece:
            begin = -(-piece // PAGE) * PAGE
            inner = (piece + size - begin) // PAGE * PAGE
            self._advise(begin, inner, _MADV_HUGEPAGE)
            self._advise(begin, inner, _MADV_POPULATE_WRITE)
            self._free(piece)


_heap: _Heap | None = None
"""Of the whole process, as the C library is."""


def hold_heap(mapped_bytes: int, spare_bytes: int) -> None:
    """Hold the C library to these numbers, where it has them (glibc): so much and more is mapped by itself, and so
    much is kept at the heap's end."""
    global _heap
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # musl has no mallopt
            _heap = _Heap(mapped_bytes, spare_bytes)


def copied(payload: Copied) -> bytes:
    """A payload as bytes."""
    if _heap is None or not _heap.mapped_bytes <= len(payload) < MOST_BYTES - BESIDES:
        return payload.to_bytes()
    with _heap.place(len(payload)):
        return payload.to_bytes()
