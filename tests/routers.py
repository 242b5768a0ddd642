"""Moved to tests/support; this name goes when nothing that is under way uses it any more."""

from tests.support.routers import Router as Router
from tests.support.tools import zenohd as zenohd
