"""What a settings file may say of recordings. Pure."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from macs_zenoh.sections import Seconds, Section


class RecordSettings(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What `macs record` does without being told each time; its options win."""

    section: ClassVar[str] = "record"

    on: list[Literal["stop", "deadman"]] = []
    """What writes a ring by itself: a robot that is stopped, a dead-man that acts."""
    after_s: Seconds = 10.0
    """How long it goes on writing after that."""
    ring_bytes: Annotated[int, Meta(ge=1 << 20, le=1 << 40)] = 512 * 1024 * 1024
    """How much memory a ring may take."""
    compress: Literal["zstd", "lz4", "none"] = "lz4"
    """How chunks are made smaller."""
