"""From a folder to a wheel."""

from __future__ import annotations

import keyword
import logging
import re
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from bridge.interfaces.compile import compile_module, compiler_path
from bridge.interfaces.generate import generate
from bridge.interfaces.package import Package, prefixes
from bridge.interfaces.wheel import write_wheel
from macs_zenoh.errors import ConfigError

log = logging.getLogger("macs.interfaces")


class Built(NamedTuple):
    """A finished wheel."""

    wheel: Path
    hashes: dict[str, str]
    """The type hash of each interface, as ``as2_ca_msgs/msg/InterAgentMessage`` to ``RIHS01_...``."""


def check_python(package: Package, folder: Path) -> None:
    """Raise ConfigError when what was generated is no Python: ROS takes any word for a field, Python does not."""
    for module in sorted(folder.rglob("*.py")):
        try:
            compile(module.read_text(encoding="utf-8"), module.name, "exec")
        except SyntaxError as error:
            where = f"{module.parent.name}/{module.stem.removeprefix('_')}"
            line = (error.text or "").strip()
            words = sorted({word for word in re.findall(r"[a-z_]+", line, re.IGNORECASE) if keyword.iskeyword(word)})
            hint = f"; a field may not be named {' or '.join(words)}" if words else ""
            raise ConfigError(str(package.folder), f"{where} is of no use in Python: {line!r}{hint}") from error


def build(folder: Path, into: Path) -> Built:
    """Build a ROS interface package for this Python.

    Raises ConfigError: the folder is no interface package, or a definition is wrong; Unreachable: a tool is missing.
    """
    package = Package.read(folder)
    compiler_path()  # what is missing is said before anything is generated
    found = prefixes()
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="macs-interfaces-") as work:
        generated = generate(package, Path(work), found)
        check_python(package, generated.python)
        log.info(
            "generated %d interfaces of %s in %.1f s", len(package.definitions), package.name, time.monotonic() - began
        )
        began = time.monotonic()
        module = compile_module(package, generated, Path(work) / "objects", found)
        log.info("compiled in %.1f s", time.monotonic() - began)
        return Built(write_wheel(package, generated, module, into), generated.hashes)
