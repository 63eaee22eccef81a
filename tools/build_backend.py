"""Build backend: setuptools, with an editable install that type checkers and editors see.

The repository's root is the package. For such a layout setuptools installs an import hook, which mypy,
pyright and jedi cannot follow. :func:`build_editable` installs a path instead: a directory in the checkout
that holds one link, ``i2rl``, to the checkout.

The hooks are those of PEP 517 and PEP 660; all but ``build_editable`` are setuptools' own.
"""

import base64
import hashlib
import zipfile
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import (
    build_sdist,
    build_wheel,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

PACKAGE = "i2rl"
# Not in build/, which may be emptied while the installation lives on.
LINK_DIRECTORY = Path(".editable")
WHEEL = "Wheel-Version: 1.0\nGenerator: i2rl\nRoot-Is-Purelib: true\nTag: py3-none-any\n"


def build_editable(
    wheel_directory: str,
    config_settings: dict[str, Any] | None = None,
    metadata_directory: str | None = None,
) -> str:
    """Write a wheel that puts the directory of the link on the import path; return the wheel's name."""
    checkout = Path.cwd()
    try:
        _link(checkout)
    except OSError:  # Windows allows links to developers and administrators only
        return build_meta.build_editable(wheel_directory, config_settings, metadata_directory)
    target = Path(wheel_directory)
    metadata = target / prepare_metadata_for_build_editable(wheel_directory, config_settings)
    files = {f"_{PACKAGE}.pth": f"{checkout / LINK_DIRECTORY}\n".encode()}
    for path in sorted(metadata.rglob("*")):
        if path.is_file() and path.name not in {"RECORD", "WHEEL"}:
            files[f"{metadata.name}/{path.relative_to(metadata).as_posix()}"] = path.read_bytes()
    files[f"{metadata.name}/WHEEL"] = WHEEL.encode()
    name = f"{metadata.name.removesuffix('.dist-info')}-py3-none-any.whl"
    _write_wheel(target / name, files, record=f"{metadata.name}/RECORD")
    return name


def _link(checkout: Path) -> None:
    """Link ``.editable/i2rl`` to the checkout."""
    link = checkout / LINK_DIRECTORY / PACKAGE
    link.parent.mkdir(exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(Path(".."), target_is_directory=True)


def _write_wheel(path: Path, files: dict[str, bytes], record: str) -> None:
    """Write the files and their record, with digests and sizes, to a wheel."""
    lines = [f"{name},sha256={_digest(data)},{len(data)}\n" for name, data in files.items()]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as wheel:
        for name, data in files.items():
            wheel.writestr(name, data)
        wheel.writestr(record, "".join([*lines, f"{record},,\n"]))


def _digest(data: bytes) -> str:
    """Return the SHA-256 digest as wheels state it: URL-safe base64 without padding."""
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
