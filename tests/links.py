"""Moved to tests/support; this name goes when nothing that is under way uses it any more."""

from tests.support.links import Link as Link
from tests.support.links import counted as counted
