"""What a settings file may say of recordings. Pure."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from macs_zenoh.protocol.keyexpr import block_of
from macs_zenoh.sections import Seconds, Section

from .agents import AgentPattern, names_agents


class RecordSettings(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What `macs record` does without being told each time; its options win."""

    section: ClassVar[str] = "record"

    on: list[Literal["stop", "deadman"]] = []
    """What writes a ring by itself: a robot that is stopped, a dead-man that acts."""
    after_s: Seconds = 10.0
    """How long it goes on writing after that."""
    ring_bytes: Annotated[int, Meta(ge=1 << 20, le=1 << 40)] = 512 * 1024 * 1024
    """How much memory a ring may take."""
    ring_files: Annotated[int, Meta(ge=1, le=1_000_000)] = 100
    """So many files a ring writes by itself and for agents, then only for a signal: no robot fills the disk."""
    allow: list[AgentPattern] = []
    """Who may have the verb ``record`` write a ring or end the recording. Everybody may ask how it is getting on."""
    nice: Annotated[int, Meta(ge=0, le=19)] = 0
    """How far it steps back for others where processors are few, as `nice` has it. Where they are full all the time it
    then takes too slowly what its router has for it, and who waits for that router waits as well."""
    folder_bytes: Annotated[int, Meta(ge=1 << 20, le=1 << 50)] = 50 * 1024 * 1024 * 1024
    """`--serve` begins no file when its folder has so much, and ends those that are written, of its ring too."""
    replay_first_id: Annotated[int, Meta(ge=1, le=0xFFFF)] = 65001
    """As which robots `--serve` plays recordings: from this id on."""
    compress: Literal["zstd", "lz4", "none"] = "lz4"
    """How chunks are made smaller."""

    def _check(self) -> None:
        for number, pattern in enumerate(self.allow):
            if pattern.startswith("group/") or not names_agents(pattern):
                problem = f"{pattern!r} names no agents, as *, unity, unity/5, operator/5 and block/1 do"
                raise self._wrong(f"allow[{number}]", problem)


def is_allowed(patterns: Collection[str], agent_type: str, agent_id: int) -> bool:
    """Whether an agent is one of those in `RecordSettings.allow`."""
    own = {"*", agent_type, f"{agent_type}/{agent_id}"}
    if agent_type == "unity":
        own.add(f"block/{block_of(agent_id)}")
    return not own.isdisjoint(patterns)
