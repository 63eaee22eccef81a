"""Print the test files of the modules that changed since a branch.

The tests of ``models/process/mdp.py`` are ``tests/models/process/test_mdp.py``. Files that git does not track
yet count as changed. Changed modules without a test file of their own are named on standard error.
"""

import subprocess
import sys
from pathlib import Path

FOLDERS = ("models", "inference", "domains", "analysis", "tools")


def changed_files(base: str) -> list[Path]:
    """Return the files that differ from where the present branch left ``base``, and exist."""
    start = _git("merge-base", base, "HEAD")[0]
    names = {*_git("diff", "--name-only", start), *_git("ls-files", "--others", "--exclude-standard")}
    return sorted(Path(name) for name in names if Path(name).exists())


def tests_of(changed: list[Path]) -> tuple[list[Path], list[Path]]:
    """Return the test files of changed modules, and the modules that have none."""
    found: set[Path] = set()
    without: list[Path] = []
    for path in changed:
        if path.parts[0] == "tests" and path.name.startswith("test_"):
            found.add(path)
        if path.suffix == ".py" and path.parts[0] in FOLDERS and path.name != "__init__.py":
            test = Path("tests") / path.parent / f"test_{path.name}"
            if test.exists():
                found.add(test)
            else:
                without.append(path)
    return sorted(found), without


def _git(*arguments: str) -> list[str]:
    return subprocess.run(["git", *arguments], check=True, capture_output=True, text=True).stdout.splitlines()


if __name__ == "__main__":
    tests, untested = tests_of(changed_files(sys.argv[1]))
    if untested:
        print("Without a test file of their own:", *untested, file=sys.stderr)
    print(*tests)
