"""List the packages, and state the project's addresses.

The repository's root is ``i2rl``, and its rooms lie under it. ``I2RL_URL`` names the repository's address when a
release is built: relative links and pictures of the README then become absolute, as a package index needs them.
"""

import os
import re
from pathlib import Path

from setuptools import find_packages, setup

ROOMS = ("models", "inference", "domains", "analysis")
FOUND = find_packages(include=[pattern for room in ROOMS for pattern in (room, f"{room}.*")])


def readme(url: str) -> str:
    """Return the README, with absolute links if the repository has an address."""
    text = Path("README.md").read_text(encoding="utf-8")
    if not url:
        return text
    text = re.sub(r'((?:src|srcset)=")(?!https?:)', rf"\1{url}/raw/main/", text)
    return re.sub(r"(\]\()(?!https?:|#)", rf"\1{url}/blob/main/", text)


URL = os.environ.get("I2RL_URL", "").rstrip("/")
# The name keeps this script out of the root package.
setup(
    script_name="setup.py",
    packages=["i2rl", *(f"i2rl.{name}" for name in FOUND)],
    long_description=readme(URL),
    long_description_content_type="text/markdown",
    project_urls={"Source": URL, "Changelog": f"{URL}/blob/main/CHANGELOG.md"} if URL else {},
)
