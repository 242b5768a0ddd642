"""Moved to tests/support; this name goes when nothing that is under way uses it any more."""

from tests.support.certificates import Authority as Authority
