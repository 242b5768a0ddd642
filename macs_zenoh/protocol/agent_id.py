"""What identifies an agent: its type and its id, as ``ros/7`` in text. Pure."""

from __future__ import annotations

from typing import NamedTuple

from ..errors import OutOfRange, UsageError
from .keyexpr import type_name, type_number


class AgentId(NamedTuple):
    """An agent's type and id. Equal to a plain ``(type, id)``, so that either finds it in a table."""

    type: int
    id: int

    def __str__(self) -> str:
        return f"{type_name(self.type)}/{self.id}"

    @classmethod
    def parse(cls, text: str) -> AgentId:
        """Read ``ros/7``. Raises UsageError, OutOfRange."""
        kind, _, number = text.partition("/")
        if not number.isascii() or not number.isdigit() or len(number) > 5:
            raise UsageError(f"{text!r} is no agent: write its type and id, as ros/7")
        if int(number) > 0xFFFF:
            raise OutOfRange("agent id", int(number), 0, 0xFFFF)
        return cls(type_number(kind), int(number))
