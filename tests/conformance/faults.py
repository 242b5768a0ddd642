"""Programs with one fault each: what a proxy in front of a right one changes, and which check is to find it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from tests.conformance.proxy import Rewrite


class Fault(NamedTuple):
    """``found_by`` is the check meant for it."""

    found_by: str
    frame: Rewrite | None = None
    message: Rewrite | None = None


class Faults(dict[str, Fault]):
    """By the names of the functions that make them."""

    def frames(self, found_by: str) -> Callable[[Rewrite], Rewrite]:
        """Keep a function that changes frames."""
        return lambda rewrite: self._keep(Fault(found_by, frame=rewrite), rewrite)

    def messages(self, found_by: str) -> Callable[[Rewrite], Rewrite]:
        """Keep a function that changes messages."""
        return lambda rewrite: self._keep(Fault(found_by, message=rewrite), rewrite)

    def _keep(self, fault: Fault, rewrite: Rewrite) -> Rewrite:
        self[rewrite.__name__] = fault
        return rewrite
