"""One extension module from everything the generators wrote.

In a ROS installation an interface package is eight shared libraries, found by name at run time. A wheel has no place
for them that a loader searches, so all of it goes into the module that rclpy imports anyway,
``PACKAGE_s__rosidl_typesupport_c``, and ``dispatch.cpp`` finds the type supports inside it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sysconfig
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from bridge.interfaces.generate import Generated
from bridge.interfaces.package import Package
from macs_zenoh.errors import ConfigError, Unreachable

_LIBRARIES = [
    "rosidl_typesupport_c",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_fastrtps_cpp",
    "rosidl_typesupport_introspection_c",
    "rosidl_runtime_c",
    "rcutils",
    "rmw",
    "fastcdr",
]
_PER_PACKAGE = [
    "rosidl_generator_c",
    "rosidl_generator_py",
    "rosidl_typesupport_c",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_introspection_c",
]
_RENAMED = [
    "-Drosidl_typesupport_c__get_message_typesupport_handle_function=macs_get_message_typesupport",
    "-Drosidl_typesupport_c__get_service_typesupport_handle_function=macs_get_service_typesupport",
]


def module_name(package: str) -> str:
    """The file name of a package's extension module, as Python and rosidl_generator_py look for it."""
    return f"{package}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"


def compile_module(package: Package, generated: Generated, into: Path, prefixes: list[Path]) -> Path:
    """Compile and link. Returns the module's path.

    Raises Unreachable without g++, ConfigError when the compiler refuses what was generated.
    """
    compiler = compiler_path()
    into.mkdir(parents=True, exist_ok=True)
    depends = package.interface_packages(prefixes)
    includes = _include_options(generated, prefixes)

    def compile_one(source: Path) -> Path:
        target = into / f"{'_'.join(source.relative_to(generated.idl.parent).parts)}.o"
        language = ["-x", "c", "-std=gnu11"] if source.suffix == ".c" else ["-std=c++17"]
        _run(
            package,
            [compiler, *language, "-O2", "-fPIC", "-w", *_RENAMED, *includes, "-c", str(source), "-o", str(target)],
        )
        return target

    shutil.copy(Path(__file__).with_name("dispatch.cpp"), generated.idl.parent)
    sources = [*_sources(generated.sources), generated.idl.parent / "dispatch.cpp"]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        objects = list(pool.map(compile_one, sources))
    module = into / module_name(package.name)
    _run(package, [compiler, "-shared", "-o", str(module), *map(str, objects), *_link_options(depends, prefixes)])
    return module


def compiler_path() -> str:
    """The C++ compiler. Raises Unreachable with advice when there is none."""
    name = os.environ.get("CXX", "g++")
    path = shutil.which(name)
    if path is None:
        raise Unreachable(
            f"the C++ compiler {name}", "it is not installed. On Debian and Ubuntu: sudo apt install g++"
        )
    header = Path(sysconfig.get_path("include"), "Python.h")
    if not header.is_file():
        raise Unreachable(
            str(header), "Python's headers are missing. On Debian and Ubuntu: sudo apt install python3-dev"
        )
    return path


def _sources(roots: Iterable[Path]) -> list[Path]:
    return sorted(path for root in roots for ending in ("*.c", "*.cpp") for path in root.rglob(ending))


def _include_options(generated: Generated, prefixes: list[Path]) -> list[str]:
    import numpy as np

    folders = [*generated.sources, Path(sysconfig.get_path("include")), Path(np.get_include())]
    for prefix in prefixes:
        if (prefix / "include").is_dir():
            folders += [
                prefix / "include",
                *(path for path in sorted((prefix / "include").iterdir()) if path.is_dir()),
            ]
    return [f"-I{folder}" for folder in folders]


def _link_options(depends: dict[str, Path], prefixes: list[Path]) -> list[str]:
    """Libraries of the packages used, found again from wherever the environment is moved to."""
    site = Path(sysconfig.get_path("platlib"))
    options = ["-Wl,--as-needed"]
    for prefix in prefixes:
        lib = prefix / "lib"
        if lib.is_dir():
            options += [f"-L{lib}", f"-Wl,-rpath,$ORIGIN/{os.path.relpath(lib, site / 'package')}"]
            options += [f"-l{name}" for name in _LIBRARIES if (lib / f"lib{name}.so").exists()]
    for name, prefix in depends.items():
        own = site / name / module_name(name)
        if own.is_file() and not (prefix / "lib" / f"lib{name}__rosidl_generator_c.so").exists():
            options += [f"-L{own.parent}", f"-l:{own.name}", f"-Wl,-rpath,$ORIGIN/../{name}"]  # built as we build
        for part in _PER_PACKAGE:
            if (prefix / "lib" / f"lib{name}__{part}.so").exists():
                options.append(f"-l{name}__{part}")
    return list(dict.fromkeys(options))


def _run(package: Package, command: list[str]) -> None:
    result = subprocess.run(  # noqa: S603 - the compiler
        command, capture_output=True, text=True, check=False
    )
    if result.returncode:
        problem = next((line for line in result.stderr.splitlines() if "error" in line), result.stderr[:400])
        raise ConfigError(str(package.folder), f"the compiler refuses what was generated: {problem}")
