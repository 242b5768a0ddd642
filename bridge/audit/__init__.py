"""A record of who did what, in a file: docs/audit.md. What the lines are is `macs_zenoh.protocol.audit_chain`."""

from .notes import NO_AUDIT, Audit, who
from .writer import AuditFile, open_audit

__all__ = ["NO_AUDIT", "Audit", "AuditFile", "open_audit", "who"]
