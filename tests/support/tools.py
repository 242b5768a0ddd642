"""Tools of this machine that some tests need: which are missing, and what brings them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

PACKAGES = {
    "ip": "iproute2",
    "nft": "nftables",
    "promtool": "prometheus",
    "chromium": "chromium",
    "mcs": "mono-mcs mono-runtime libmono-system-runtime-serialization4.0-cil",
}
"""What apt calls the packages with the tools that a whole run uses."""


def zenohd() -> str | None:
    """Where zenohd is: on PATH, or where cargo installs it."""
    beside_cargo = Path(os.environ.get("CARGO_HOME", Path.home() / ".cargo")) / "bin" / "zenohd"
    return shutil.which("zenohd") or (str(beside_cargo) if beside_cargo.exists() else None)


def missing() -> list[str]:
    """The tools that are not here."""
    tools = [tool for tool in PACKAGES if shutil.which(tool) is None]
    return tools + ([] if zenohd() else ["zenohd"])


def advice() -> str | None:
    """One line: what is missing, what that costs, and the command that brings it; None when nothing is."""
    tools = missing()
    if not tools:
        return None
    packages = " ".join(PACKAGES[tool] for tool in tools if tool in PACKAGES)
    commands = [f"apt-get install {packages}"] if packages else []
    if "zenohd" in tools:
        commands.append("make zenohd")
    return (
        f"without {', '.join(tools)} some tests were skipped, or used the router in the wheel: {'; '.join(commands)}"
    )
