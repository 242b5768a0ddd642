"""What pyproject.toml cannot say: the README as PyPI shows it, whose links lead to the repository, and the libraries
of the page, which are fetched from npm while a wheel is built."""

import re
import subprocess
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

HERE = Path(__file__).parent


def long_description() -> str:
    """The README with absolute links; the repository's address is the one in pyproject.toml."""
    found = re.search(r'^Repository = "(.+)"$', (HERE / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
    assert found is not None

    def absolute(link: re.Match[str]) -> str:
        kind = "tree" if link[2].endswith("/") else "raw" if link[2].endswith((".png", ".svg")) else "blob"
        return f"{link[1]}{found[1]}/{kind}/main/{link[2]}"

    return re.sub(r"(\]\()(?![a-z]+:|#)([^)]+)", absolute, (HERE / "README.md").read_text(encoding="utf-8"))


class BuildWithPage(build_py):
    """Puts the libraries of the page in place where they are not. A wheel without them works, and its page says so."""

    def run(self):
        if not self.editable_mode:
            subprocess.run([sys.executable, str(HERE / "bridge" / "page" / "libraries.py")], check=False)  # noqa: S603
        super().run()


setup(
    cmdclass={"build_py": BuildWithPage},
    long_description=long_description(),
    long_description_content_type="text/markdown",
)
