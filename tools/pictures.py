"""Draw the pictures of the README and of the Start page anew, into ``docs/pictures``.

``make pictures`` runs the patrol study, a sorting study and the code of the Start page. Pictures of studies
are those that their commands write.
"""

import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

from i2rl.compilation import compile_quickly, keep_programs

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "pictures"
START = FOLDER.parent / "index.md"
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "i2rl/Breach2-v0": {},
    "i2rl/SortingWithClaiming-v0": {},
    "i2rl/Labyrinth-v0": {},
    "i2rl/ObjectWorld-v0": {"layout": 3},
}
HEIGHT = 400


def draw_studies(folder: Path) -> None:
    """Draw the hidden path of the patrol study and the components of the sorting study."""
    from i2rl.analysis import patrol_study, sorting_study
    from i2rl.analysis.studies.patrol.study import write as write_patrol
    from i2rl.analysis.studies.sorting.page import write as write_sorting

    write_patrol(patrol_study(2, trials=1, replications=1, methods=["lme-i2rl"]), folder / "patrol")
    study = sorting_study(2, (16,), replications=1, belts=1, methods=["mme-mtirl"])
    write_sorting(study, folder / "sorting")
    for theme in ("light", "dark"):
        shutil.copy(folder / "patrol" / f"hidden-path-{theme}.png", FOLDER)
        shutil.copy(folder / "sorting" / f"components-{theme}.png", FOLDER)


def draw_start() -> None:
    """Run the code of the Start page up to its picture, which is drawn in both themes instead."""
    from i2rl.analysis import completed_path
    from i2rl.analysis.drawing.style import save_themes

    blocks = re.findall(r"```python\n(.*?)```", START.read_text(), re.DOTALL)
    made: dict[str, object] = {}
    for code in blocks[: 1 + next(i for i, code in enumerate(blocks) if "completed_path" in code)]:
        exec(compile(code.partition("picture = ")[0], str(START), "exec"), made)
    mdp, posterior, layout, states = (made[name] for name in ("mdp", "posterior", "layout", "states"))
    save_themes(
        lambda theme: completed_path(mdp, posterior, [6], layout, path=states[6], theme=theme),  # type: ignore
        FOLDER,
        "start",
    )


def draw_environments() -> None:
    """Render one environment of each domain, side by side."""
    import gymnasium
    from PIL import Image

    import i2rl.domains  # noqa: F401  (registers them)

    pictures = []
    for name, options in ENVIRONMENTS.items():
        environment = gymnasium.make(name, render_mode="rgb_array", **options)
        environment.reset(seed=0)
        picture = Image.fromarray(environment.render())  # type: ignore[arg-type]
        pictures.append(picture.resize((round(picture.width * HEIGHT / picture.height), HEIGHT)))
    whole = Image.new("RGB", (sum(p.width for p in pictures), HEIGHT), "white")
    left = 0
    for picture in pictures:
        whole.paste(picture, (left, 0))
        left += picture.width
    whole.save(FOLDER / "environments.png")


def main() -> None:
    """Draw them all."""
    compile_quickly()
    keep_programs()
    with tempfile.TemporaryDirectory() as folder:
        draw_studies(Path(folder))
    draw_start()
    draw_environments()


if __name__ == "__main__":
    main()
