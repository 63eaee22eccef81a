"""Check the types of the code on the README and on every page, as a user's own checker would.

``python tools/check_pages.py`` writes each page's code to ``build/lint/pages`` and runs mypy on it. ArviZ
does not declare the groups of an ``InferenceData``, so complaints about those are left out.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "build" / "lint" / "pages"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
UNDECLARED = "InferenceData"


def write_code(page: Path) -> Path | None:
    """Write a page's Python to a file, each line where it stands on the page; None if it has none."""
    inside, lines = False, []
    for line in page.read_text().splitlines():
        fence = line.startswith("```")
        lines.append(line if inside and not fence else "")
        inside = line.startswith("```python") if fence else inside
    if not any(lines):
        return None
    target = FOLDER / (re.sub(r"\W", "_", str(page.relative_to(ROOT))) + ".py")
    target.write_text("\n".join(lines) + "\n")
    return target


def main() -> int:
    """Print what mypy finds; 1 if that is anything."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    files = [str(path) for page in PAGES if (path := write_code(page))]
    # A user's checker has no settings of this project's, and reports no error inside it.
    settings = FOLDER / "mypy.ini"
    settings.write_text("[mypy]\nignore_missing_imports = True\nfollow_imports = silent\n")
    options = ["--config-file", str(settings), "--no-error-summary"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, *files],
        env={**os.environ, "MYPYPATH": os.environ.get("MYPYPATH", str(ROOT / ".editable"))},
        capture_output=True,
        text=True,
        check=False,
    )
    found = [line for line in done.stdout.splitlines() if UNDECLARED not in line]
    print("\n".join([*found, done.stderr]).strip() or f"The code of {len(files)} pages is typed as written.")
    return int(bool(found or done.stderr))


if __name__ == "__main__":
    raise SystemExit(main())
