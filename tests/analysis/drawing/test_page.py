"""Pages of studies: one first screen, spelled-out acronyms, plain numbers, names as they are, provenance."""

from __future__ import annotations

import io
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from i2rl.analysis.drawing import charts as figures
from i2rl.analysis.drawing import style
from i2rl.analysis.drawing.estimates import Estimates, laplace_errors
from i2rl.analysis.drawing.page import GLOSSARY, Lead, Picture, Section, Table, print_tables, write_page
from i2rl.analysis.drawing.results import command_line, plain, study_provenance

LEAD = Lead("A reward was learned.", "Trust it.")
RESULTS = {"provenance": study_provenance(3)}


def written(folder: Path, sections: list[Section], lead: Lead = LEAD, results: dict | None = None) -> str:
    return write_page(folder, "A study", lead, sections, results or RESULTS).read_text(encoding="utf-8")


def test_a_page_is_one_file_that_needs_no_network(tmp_path):
    light, dark = style.save_themes(
        lambda theme: figures.weights_plot(["a", "b"], np.ones(2), np.ones(2), theme=theme),
        tmp_path,
        "weights",
    )
    picture = Picture(light, dark, "Weights <learned>.", 'Two "dots"')
    table = Table(["method", "share"], [["a & b", 0.97], ["c", 1]], "Shares of states.")
    page = written(tmp_path / "out", [Section("Results", "First.\n\nSecond <b>.", [table], [picture])])
    light.unlink()
    dark.unlink()
    assert not re.search(r"(?:src|srcset|href)=\"(?!data:)", page)
    assert page.count("data:image/png;base64,") == 2
    assert "prefers-color-scheme: dark" in page
    assert "<p>First.</p>" in page
    assert "Second &lt;b&gt;." in page
    assert "Weights &lt;learned&gt;" in page
    assert 'alt="Two &quot;dots&quot;"' in page
    assert '<td>a &amp; b</td><td class="number">0.97</td>' in page


def test_the_first_screen_says_what_was_learned_and_whether_to_trust_it_then_the_weights(tmp_path):
    weights = Table(["feature", "weight"], [["speed [m/s]", 2214.4]])
    page = written(tmp_path, [Section("Later", "Text.")], LEAD._replace(weights=[weights]))
    places = [page.index(x) for x in ("<h1>", "A reward was learned. Trust it.", "speed [m/s]", "<h2>Later")]
    assert places == sorted(places)
    assert '<td class="number">2,214</td>' in page


@pytest.mark.parametrize(
    ("lead", "sections", "message"),
    [
        (LEAD._replace(trust=""), [], "`lead.trust` must be a sentence that ends with a full stop; got ''"),
        (LEAD._replace(learned="Nothing"), [], "`lead.learned` must be a sentence"),
        (
            LEAD,
            [Section("S", tables=[Table(["a"], [[1]], "Weights")])],
            "'S': a table's caption must be a sen",
        ),
        (
            LEAD,
            [Section("S", tables=[Table(["a", "b"], [[1, 2], [3]])])],
            "'S': row 1 has 1 cells under 2 head",
        ),
    ],
)
def test_a_page_without_its_sentences_is_refused_and_nothing_written(tmp_path, lead, sections, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        written(tmp_path, sections, lead)
    assert not list(tmp_path.iterdir())


def test_a_missing_picture_or_missing_provenance_is_refused_and_nothing_written(tmp_path):
    with pytest.raises(FileNotFoundError):
        written(tmp_path, [Section("S", pictures=[Picture("no.png", "no.png", "A picture.", "")])])
    with pytest.raises(ValueError, match="`results` must hold the key 'provenance'; got seed"):
        written(tmp_path, [], results={"seed": 1})
    assert not list(tmp_path.iterdir())


def test_acronyms_are_spelled_out_where_they_first_stand_and_only_there(tmp_path):
    table = Table(["method", "LBA", "ILE"], [["LME-I2RL, seen", 0.5, 0.1]], "Medians of LBA.")
    page = written(tmp_path, [Section("S", "LME-I2RL learns. LBA of LME-I2RL, not of xLBA.", [table])])
    for name in ("LBA", "LME-I2RL", "ILE"):
        assert page.count(GLOSSARY[name]) == 1
    assert f"LME-I2RL ({GLOSSARY['LME-I2RL']}) learns" in page
    # In a table's cell there is no room: its caption says it.
    assert f"Medians of LBA. ILE: {GLOSSARY['ILE']}." in page
    assert "<th>method</th>" in page
    assert GLOSSARY["I2RL"] not in page.replace(GLOSSARY["LME-I2RL"], "")


def test_backticks_become_code_and_names_stay_names(tmp_path):
    name = "<script>alert('x')</script>\x1b[31m"
    page = written(tmp_path, [Section(name, f"Run `i2rl {name}` now.", [Table([name], [[name]])])])
    assert "`" not in page
    assert "<script" not in page
    assert "\x1b" not in page
    assert "<code>i2rl &lt;script&gt;" in page
    assert "\\x1b[31m</h2>" in page


def test_results_are_strict_json_and_say_where_they_come_from(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/i2rl", "run", "patrol", "--folder", "a folder"])
    values = {"share": np.array([0.5, np.nan]), "count": np.int64(3), "pair": (1.0, float("inf"))}
    page = written(tmp_path, [], results={"provenance": study_provenance(7), **values})
    content = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)
    assert (content["share"], content["count"], content["pair"]) == ([0.5, None], 3, [1.0, None])
    made = content["provenance"]
    assert made["command"] == "i2rl run patrol --folder 'a folder'"
    assert made["seed"] == 7
    assert made["versions"]["numpy"] == np.__version__
    assert "i2rl run patrol --folder &#x27;a folder&#x27;" in page
    assert f"NumPy {np.__version__}".lower() in page.lower()


def test_plain_data_keeps_what_json_takes():
    assert plain({1: [True, None, "a", 2]}) == {"1": [True, None, "a", 2]}
    assert command_line(["/x/analysis/cli.py", "show", "a b"]) == "i2rl show 'a b'"
    assert command_line(["pytest", "-q"]) == "pytest -q"


def test_tables_on_a_terminal_show_names_and_numbers_as_the_page_does():
    console = Console(file=io.StringIO(), width=100, color_system=None)
    print_tables([Table(["[b]rate[/b]", "n"], [["turn [/s]", 1e-7], ["", 12345]], "All [of] them.")], console)
    shown = console.file.getvalue()
    for text in ("[b]rate[/b]", "turn [/s]", "1 × 10⁻⁷", "12,345", "All [of] them."):
        assert text in shown


# -- estimates ----------------------------------------------------------------------------------------


def test_errors_are_those_of_the_inverse_information():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 5))
    information = root @ root.T
    np.testing.assert_allclose(laplace_errors(information), np.sqrt(np.diag(np.linalg.inv(information))))
    # A direction without information leaves the weights that it moves undetermined, and no others.
    partial = np.zeros((3, 3))
    partial[:2, :2] = [[4.0, 0.0], [0.0, 1.0]]
    np.testing.assert_allclose(laplace_errors(partial), [0.5, 1.0, np.inf])


def test_weights_are_given_with_intervals_and_where_they_are_not_determined_without():
    found = Estimates(("a", "b", "c"), np.array([2.0, -1.0, 0.0]), np.array([0.5, 1.0, np.inf]))
    np.testing.assert_allclose(found.intervals[0], [1.02, 2.98])
    assert found.determined == ["a"]
    table = found.table("Weights.", np.array([1.0, 0.0, -1.0]))
    assert table.rows[0] == ["a", 2.0, "1.02 to 2.98", "+0.67", "+0.50"]
    assert table.rows[2][2] == "not determined"
    assert found.summary()[0]["95 % interval"] == pytest.approx([1.02, 2.98])
    assert found.summary()[2]["95 % interval"] is None
    assert json.dumps(found.summary(), allow_nan=False)
