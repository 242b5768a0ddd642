"""Which modules add something to a gateway's web port."""

from __future__ import annotations

from bridge.page.recordings import add_recordings
from bridge.page.routes import add_page

from .figures import add_figures
from .site import Site


def add_routes(site: Site) -> None:
    """Let each module that has something to show add it."""
    add_figures(site)
    add_page(site)
    add_recordings(site)
