"""List the packages: the repository's root is ``i2rl``, and its rooms lie under it."""

from setuptools import find_packages, setup

ROOMS = ("models", "inference", "domains", "analysis")
FOUND = find_packages(include=[pattern for room in ROOMS for pattern in (room, f"{room}.*")])

# The name keeps this script out of the root package.
setup(script_name="setup.py", packages=["i2rl", *(f"i2rl.{name}" for name in FOUND)])
