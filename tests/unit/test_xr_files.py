"""The scene for headsets as files: what only tests use is not in it, and who starts a site is told where it is."""

from __future__ import annotations

import json
from pathlib import Path

from bridge.cli import up
from bridge.cli.up import Plan, what_next
from bridge.page import files, libraries
from bridge.settings import GatewaySettings, RobotSettings

LOCK = Path(libraries.__file__).parent / "npm" / "package-lock.json"


def test_the_emulator_is_only_for_tests() -> None:
    """Neither it nor what it needs, nor what opens recordings, is fetched for a wheel; no file of a scene names it."""
    packages = json.loads(LOCK.read_text(encoding="utf-8"))["packages"]
    for name in ("iwer", "gl-matrix", "webxr-layers-polyfill", "@mcap/core", "@mcap/support"):
        assert packages[f"node_modules/{name}"]["dev"] is True
    assert "dev" not in packages["node_modules/three"]
    for path in (files.FOLDER / "xr").rglob("*"):
        assert "iwer" not in path.read_text(encoding="utf-8").lower(), path


def test_the_page_works_without_the_scene_s_library() -> None:
    """Only the scene says that it is missing."""
    found = dict.fromkeys(files.LIBRARIES, files.without_libraries())
    assert not files.missing(found)
    assert files.missing(found, files.XR_LIBRARIES)


def test_who_starts_a_site_is_told_where_the_scene_is() -> None:
    """As an address to open, where there is a web port."""
    plan = Plan(
        gateway=GatewaySettings(port=7000, web_host="127.0.0.1", web_port=7080),
        robot=RobotSettings(id=1),
        router_port=7447,
        routers=["tcp/127.0.0.1:7447"],
        settings_files=[],
        apart=None,
        once=False,
        verbose=False,
    )
    assert "In a headset's browser: http://127.0.0.1:7080/xr" in what_next(plan).splitlines()
    assert "/xr" in (up.__doc__ or "")
