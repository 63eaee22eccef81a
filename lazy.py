"""Names of a package loaded when they are first used, from the stub beside its ``__init__``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

import lazy_loader

from .extras import EXTRA_OF


def attached(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package that has ``__init__.pyi``.

    The stub is what type checkers and editors read, so every name stands once. A name whose optional packages
    are missing is a stand-in: star imports and ``help()`` work, and its use raises ``ImportError`` that says
    which extra to install.
    """
    load, directory, names = lazy_loader.attach_stub(package, file)

    def __getattr__(name: str) -> Any:
        try:
            return load(name)
        except ModuleNotFoundError as missing:
            if missing.name not in EXTRA_OF:
                raise
            return _stand_in(name, package, missing)

    return __getattr__, directory, names


def _stand_in(name: str, package: str, missing: ModuleNotFoundError) -> Any:
    def use(*_: Any, **__: Any) -> NoReturn:
        raise ModuleNotFoundError(str(missing), name=missing.name) from missing

    use.__name__ = use.__qualname__ = name
    use.__module__ = package
    use.__doc__ = f"Not available here: {missing}"
    return use
