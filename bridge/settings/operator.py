"""What a settings file may say of who looks after a mesh from a command line. Pure."""

from __future__ import annotations

from typing import ClassVar

from macs_zenoh.sections import AgentId, Section


class OperatorSettings(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Who asks robots and stops them from a command line."""

    section: ClassVar[str] = "operator"

    id: AgentId | None = None
    """Makes it ``operator/5``, for robots and access rules that want to know (``--as`` wins). Unset: ``operator/0``,
    who is nobody in particular."""
