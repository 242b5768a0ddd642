"""A wheel: the Python package with its extension module, and what other ROS packages look for in ``share``."""

from __future__ import annotations

import base64
import hashlib
import sysconfig
import zipfile
from pathlib import Path

from bridge.interfaces.compile import module_name
from bridge.interfaces.generate import Generated
from bridge.interfaces.package import Package

_STAMP = (1980, 1, 1, 0, 0, 0)
"""The same definitions give the same wheel."""


def write_wheel(package: Package, generated: Generated, module: Path, into: Path) -> Path:
    """Pack it; returns the wheel's path."""
    python = f"cp{sysconfig.get_config_var('py_version_nodot')}"
    tag = f"{python}-{python}-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
    base = f"{package.name}-{package.version}"
    into.mkdir(parents=True, exist_ok=True)
    path = into / f"{base}-{tag}.whl"
    contents = _contents(package, generated, module, f"{base}.data/data")
    contents[f"{base}.dist-info/METADATA"] = _metadata(package)
    contents[f"{base}.dist-info/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: macs interfaces\nRoot-Is-Purelib: false\nTag: {tag}\n".encode()
    )
    record = "".join(f"{name},sha256={_digest(data)},{len(data)}\n" for name, data in contents.items())
    contents[f"{base}.dist-info/RECORD"] = f"{record}{base}.dist-info/RECORD,,\n".encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in contents.items():
            entry = zipfile.ZipInfo(name, _STAMP)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data)
    return path


def _contents(package: Package, generated: Generated, module: Path, data: str) -> dict[str, bytes]:
    name = package.name
    files = {
        f"{name}/{path.relative_to(generated.python)}": path.read_bytes()
        for path in sorted(generated.python.rglob("*.py"))
    }
    files[f"{name}/{module_name(name)}"] = module.read_bytes()
    registered = []
    for path in package.definitions:
        files[f"{data}/share/{name}/{path}"] = (package.folder / path).read_bytes()
        registered.append(str(path))
    for path in sorted(generated.idl.rglob("*.*")):
        relative = path.relative_to(generated.idl)
        files[f"{data}/share/{name}/{relative}"] = path.read_bytes()
        if path.suffix == ".idl":
            registered.append(str(relative))
    for root in generated.sources:
        for path in sorted(root.rglob("*.h")):
            files[f"{data}/include/{name}/{path.relative_to(root)}"] = path.read_bytes()
    files[f"{data}/share/{name}/package.xml"] = (package.folder / "package.xml").read_bytes()
    index = f"{data}/share/ament_index/resource_index"
    files[f"{index}/rosidl_interfaces/{name}"] = "\n".join(sorted(registered)).encode()
    files[f"{index}/packages/{name}"] = b""
    return files


def _metadata(package: Package) -> bytes:
    lines = ["Metadata-Version: 2.1", f"Name: {package.name}", f"Version: {package.version}"]
    return "\n".join([*lines, f"Summary: {package.description or 'ROS interfaces'}", ""]).encode()


def _digest(data: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
