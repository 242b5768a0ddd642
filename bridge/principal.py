"""Whose rights somebody uses: what ``--as`` says, read the same way by every verb. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from bridge.settings import Settings
from macs_zenoh.errors import UsageError
from macs_zenoh.protocol.keyexpr import BLOCK_SIZE, type_number
from macs_zenoh.protocol.messages import NOBODY, UNITY

GRAMMAR = "ros/7, unity/5, gateway/1 (its block), operator/5 or observer"


@dataclass(frozen=True)
class Principal:
    """A robot or another agent (its id), a gateway (its first block), an operator, who calls robots and is not online,
    or an observer, who is nobody in particular."""

    kind: str = ""
    number: int = 0
    group: int = 0

    @classmethod
    def parse(cls, text: str) -> Principal:
        """What stands in `GRAMMAR`, and ``operator`` for ``operator/0``. Raises UsageError."""
        kind, slash, number = text.partition("/")
        if kind == "observer" and not slash:
            return cls()
        if kind == "operator" and not slash:
            return cls(kind)
        highest = 255 if kind == "gateway" else 65_535
        if not number.isascii() or not number.isdigit() or int(number) > highest:
            raise UsageError(f"{text!r} is nobody: use {GRAMMAR}")
        if kind != "gateway":
            type_number(kind)
        return cls(kind, int(number))

    @classmethod
    def of(cls, settings: Settings) -> Principal:
        """Who the settings are for, as far as they say."""
        if settings.robot.id is not None:
            return cls("ros", settings.robot.id, settings.robot.group)
        gateway = settings.gateway
        blocks = [*([gateway.block] if gateway.block is not None else []), *gateway.blocks]
        if blocks:
            return cls("gateway", blocks[0])
        return cls("operator", settings.operator.id) if settings.operator.id is not None else cls()

    def __str__(self) -> str:
        return f"{self.kind}/{self.number}" if self.kind else ""

    @property
    def agent(self) -> tuple[int, int]:
        """(type, id) that it may be. A gateway is its headsets; the last id of its block is given out last."""
        if self.kind == "gateway":
            return UNITY, self.number * BLOCK_SIZE + BLOCK_SIZE - 1
        return (type_number(self.kind), self.number) if self.kind else (NOBODY, 0xFFFF)

    @property
    def joins(self) -> bool:
        """Whether it is online when it runs, and hears what is sent to it."""
        return self.kind not in ("", "operator")

    @property
    def calls(self) -> bool:
        """Whether it calls robots."""
        return self.kind in ("gateway", "operator")
