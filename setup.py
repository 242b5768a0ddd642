"""What pyproject.toml cannot say: the README as PyPI shows it, whose links lead to the repository."""

import re
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).parent


def long_description() -> str:
    """The README with absolute links; the repository's address is the one in pyproject.toml."""
    found = re.search(r'^Repository = "(.+)"$', (HERE / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
    assert found is not None

    def absolute(link: re.Match[str]) -> str:
        kind = "tree" if link[2].endswith("/") else "blob"
        return f"{link[1]}{found[1]}/{kind}/main/{link[2]}"

    return re.sub(r"(\]\()(?![a-z]+:|#)([^)]+)", absolute, (HERE / "README.md").read_text(encoding="utf-8"))


setup(long_description=long_description(), long_description_content_type="text/markdown")
