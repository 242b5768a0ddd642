"""ROS's own generators, run without CMake: from definitions to C, C++ and Python sources.

Each generator writes into a folder of its own, because some of their file names are the same. The order is ROS's: IDL
from the definitions, type descriptions with their hashes (REP-2011) from the IDL, sources from both.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from bridge.interfaces.package import Package
from macs_zenoh.errors import ConfigError, Unreachable

log = logging.getLogger("macs.interfaces")

# What rclpy's middleware asks for: rmw_fastrtps takes the first, and refuses a type that has not the second as well.
TYPESUPPORTS = ["rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"]


class Generated(NamedTuple):
    """Where everything was written."""

    idl: Path
    """``msg/Pose.idl`` and the original definitions' type descriptions, ``msg/Pose.json``."""
    sources: list[Path]
    """One folder per generator, each with ``PACKAGE/msg/...``."""
    python: Path
    """The Python package's folder; C conversions are beside its modules."""
    hashes: dict[str, str]
    """``as2_ca_msgs/msg/InterAgentMessage`` to ``RIHS01_...``."""


def generate(package: Package, into: Path, prefixes: list[Path]) -> Generated:
    """Write all sources of a package below ``into``.

    Raises ConfigError for a definition that ROS does not accept, Unreachable where the generators are not installed.
    """
    generators = _Generators(package, into, prefixes)
    captured = io.StringIO()
    try:
        # the generators report to stdout, which is for data here
        with contextlib.redirect_stdout(captured), contextlib.redirect_stderr(captured):
            return generators.run()
    except (ConfigError, Unreachable):
        raise
    except Exception as error:
        log.debug("%s", captured.getvalue())
        where = next((line for line in captured.getvalue().splitlines() if line.startswith("Error")), "")
        raise ConfigError(str(package.folder), f"ROS does not accept it: {error} {where}".strip()) from error


def _tool(name: str) -> Any:
    """A module of ROS's generators."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise Unreachable(
            "ROS's interface generators",
            f"{error}; they come with: pip install 'macs-zenoh[ros]'. With a ROS installation, build with colcon",
        ) from error


class _Generators:
    def __init__(self, package: Package, into: Path, prefixes: list[Path]) -> None:
        self.package = package
        self.into = into
        self.prefixes = prefixes
        self.depends = package.interface_packages(prefixes)
        self.idl = into / "idl"
        self.descriptions: dict[str, Path] = {}

    def run(self) -> Generated:
        os.environ.setdefault("AMENT_PREFIX_PATH", os.pathsep.join(map(str, self.prefixes)))
        relative = [self._translate(path) for path in self.package.definitions]
        self._describe(relative)
        c = self._generate("rosidl_generator_c", "generate_c", relative)
        self._visibility("rosidl_generator_c", c)
        fast = self._generate("rosidl_typesupport_fastrtps_c", "generate_typesupport_fastrtps_c", relative)
        self._visibility("rosidl_typesupport_fastrtps_c", fast)
        introspection = self._generate("rosidl_typesupport_introspection_c", "generate_c", relative)
        self._visibility("rosidl_typesupport_introspection_c", introspection)
        dispatch = self._generate("rosidl_typesupport_c", "generate_c", relative, TYPESUPPORTS)
        python = self._generate("rosidl_generator_py", "generate_py", relative, ["rosidl_typesupport_c"])
        (python / self.package.name / "__init__.py").touch()
        hashes = {}
        for path in self.descriptions.values():
            (entry, *_) = json.loads(path.read_text(encoding="utf-8"))["type_hashes"]
            hashes[entry["type_name"]] = entry["hash_string"]
        return Generated(self.idl, [c, fast, introspection, dispatch, python], python / self.package.name, hashes)

    def _translate(self, definition: Path) -> Path:
        kind = definition.suffix[1:]
        convert: Callable[..., Path] = getattr(_tool(f"rosidl_adapter.{kind}"), f"convert_{kind}_to_idl")
        convert(self.package.folder, self.package.name, definition, self.idl / kind)
        return definition.with_suffix(".idl")

    def _describe(self, relative: list[Path]) -> None:
        """Type descriptions and hashes, beside the IDL, where packages that use these types look for them."""
        includes = [f"{name}:{prefix / 'share' / name}" for name, prefix in self.depends.items()]
        arguments = self._arguments("rosidl_generator_type_description", relative, self.idl, include_paths=includes)
        written = _tool("rosidl_generator_type_description").generate_type_hash(arguments)
        by_name = {f"{path.parent.name}/{path.stem}": path for path in map(Path, written)}
        self.descriptions = {str(path): by_name[f"{path.parent.name}/{path.stem}"] for path in relative}

    def _generate(self, tool: str, function: str, relative: list[Path], *more: list[str]) -> Path:
        root = self.into / tool
        for kind in self.package.kinds:
            (root / self.package.name / kind).mkdir(parents=True, exist_ok=True)
        arguments = self._arguments(
            tool,
            relative,
            root / self.package.name,
            type_description_tuples=[f"{idl}:{path}" for idl, path in self.descriptions.items()],
            ros_interface_files=[str(self.package.folder / path) for path in self.package.definitions],
        )
        getattr(_tool(tool), function)(arguments, *more)
        return root

    def _arguments(self, tool: str, relative: list[Path], output: Path, **more: object) -> str:
        """The file in which a generator expects its arguments."""
        arguments = {
            "package_name": self.package.name,
            "output_dir": str(output),
            "template_dir": str(self._share(tool) / "resource"),
            "idl_tuples": [f"{self.idl}:{path.as_posix()}" for path in relative],
            "ros_interface_dependencies": [],
            "target_dependencies": [],
            **more,
        }
        path = self.into / f"{tool}.json"
        path.write_text(json.dumps(arguments), encoding="utf-8")
        return str(path)

    def _share(self, tool: str) -> Path:
        for prefix in self.prefixes:
            if (prefix / "share" / tool).is_dir():
                return prefix / "share" / tool
        raise Unreachable(f"ROS's generator {tool}", "its templates are not installed")

    def _visibility(self, tool: str, root: Path) -> None:
        """The header with the export macros, one per package and generator."""
        template = (self._share(tool) / "resource" / f"{tool}__visibility_control.h.in").read_text(encoding="utf-8")
        text = template.replace("@PROJECT_NAME@", self.package.name)
        text = text.replace("@PROJECT_NAME_UPPER@", self.package.name.upper())
        folder = root / self.package.name / "msg"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{tool}__visibility_control.h").write_text(text, encoding="utf-8")
