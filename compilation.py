"""Compile in less time, and keep compiled programs between processes, in the user's cache folder.

A first session waits for the compiler far longer than for its own work. JAX can keep what it compiled on disk
and load it in the next process; :func:`keep_programs` switches that on. The command line, the tests and the
execution of notebooks call it. Importing the library does not: which programs a process keeps, and where, is
the decision of whoever wrote the process. A script or a notebook decides with its first two lines::

    from i2rl.compilation import keep_programs
    keep_programs()

The environment variable ``I2RL_CACHE`` names another folder, or switches the cache off with ``off``. What a
user has set for JAX itself stands: a cache folder (``JAX_COMPILATION_CACHE_DIR`` or ``jax.config``) and the
shortest compilation that is kept (``JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS``).

:func:`compile_quickly` asks XLA for its first level of optimisation and for its older code of fused loops:
this project's programs then compile in half the time and run as fast.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import tempfile
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

# Programs that compile faster are not kept. Loading one takes about 5 ms, and a process of this project
# compiles dozens of programs of 20 to 300 ms each beside the few that take seconds.
_SHORTEST_SECONDS = 0.02
# Beyond the first size the programs that were not used for longest are removed, down to the second. JAX has a
# bound of its own, but it locks the folder at every access, and a process that is killed between its two
# files of an entry keeps all others from writing.
_LARGEST_BYTES = 2 * 2**30
_PRUNED_BYTES = 3 * 2**29
_SETTINGS = {
    "jax_compilation_cache_dir": "JAX_COMPILATION_CACHE_DIR",
    "jax_persistent_cache_min_compile_time_secs": "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
}
_refused: set[Path] = set()


def keep_programs() -> Path | None:
    """Keep this process's compiled programs, and those of its child processes, for the next one.

    Returns the folder, or None where this changes nothing: ``I2RL_CACHE`` is ``off``, or JAX has a cache
    folder already. A folder that cannot be written is reported once on standard error, and nothing is kept.
    Call it before anything is compiled.
    """
    place = os.environ.get("I2RL_CACHE", "")
    if place.lower() == "off" or _chosen("jax_compilation_cache_dir", None):
        return None
    folder = (Path(place).expanduser() if place else _user_folder()).absolute() / _machine()
    if folder in _refused:
        return None
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        _prune(folder)
    except OSError as error:
        _refused.add(folder)
        print(
            f"Compiled programs are not kept: {folder}: {error.strerror or error} "
            "(I2RL_CACHE names another folder, or is off)",
            file=sys.stderr,
        )
        return None
    if not _chosen("jax_persistent_cache_min_compile_time_secs", 1.0):
        _set("jax_persistent_cache_min_compile_time_secs", _SHORTEST_SECONDS)
    _set("jax_compilation_cache_dir", str(folder))
    return folder


def compile_quickly() -> None:
    """Compile this process's programs, and those of its child processes, with less optimisation.

    The first level of XLA's optimisation is taken (the highest, 3, is JAX's own default), and fused loops are
    written by XLA's older code. An ``XLA_FLAGS`` that names one of the two stands. Call it before anything is
    computed.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    wanted = {"xla_backend_optimization_level": "1"}
    # A flag that XLA does not know ends the process, so only releases are asked that are known to have it.
    if (0, 6) <= tuple(int(part) for part in version("jaxlib").split(".")[:2]) <= (0, 10):
        wanted["xla_cpu_use_fusion_emitters"] = "false"
    missing = [f"--{name}={value}" for name, value in wanted.items() if name not in flags]
    if missing:
        os.environ["XLA_FLAGS"] = " ".join([flags, *missing]).strip()


def _chosen(setting: str, default: object) -> bool:
    """Say whether the user has set this already, in the environment or in JAX."""
    if os.environ.get(_SETTINGS[setting]):
        return True
    jax = sys.modules.get("jax")
    return jax is not None and getattr(jax.config, setting) not in (default, "")


def _set(setting: str, value: str | float) -> None:
    # The environment is for child processes, and for a JAX that is not imported yet: importing it here would
    # make commands wait that need none.
    os.environ[_SETTINGS[setting]] = str(value)
    if "jax" in sys.modules:
        sys.modules["jax"].config.update(setting, value)


def _user_folder() -> Path:
    from platformdirs import user_cache_path

    return user_cache_path("i2rl", appauthor=False) / "programs"


def _machine() -> str:
    """Name the kind of processor: machines that share a home may not run each other's programs."""
    described = platform.machine() + platform.processor()
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
        described += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return f"{platform.machine()}-{hashlib.sha256(described.encode()).hexdigest()[:8]}"


def _prune(folder: Path) -> None:
    """Remove the programs that were not used for longest, where the folder has grown beyond its bound."""
    entries = []
    with os.scandir(folder) as found:
        for entry in found:
            with suppress(FileNotFoundError):  # another process prunes too
                status = entry.stat()
                entries.append((max(status.st_atime, status.st_mtime), status.st_size, entry.path))
    size = sum(entry[1] for entry in entries)
    if size <= _LARGEST_BYTES:
        return
    for _, bytes_, path in sorted(entries):
        if size <= _PRUNED_BYTES:
            break
        with suppress(OSError):
            os.remove(path)
        size -= bytes_
