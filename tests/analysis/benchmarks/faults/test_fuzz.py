"""Hostile lines and archives, a small part of the benchmark's."""

from __future__ import annotations

import re

import pytest

from i2rl.analysis.benchmarks.faults import fuzz
from i2rl.models import DemonstrationError, StorageError
from i2rl.models.observation.demonstration import LineLimits
from i2rl.models.observation.storage import load_mdp


def test_twenty_thousand_fuzzed_lines_are_read_or_refused_by_line():
    tallies = fuzz.fuzz_lines(1, 5000)
    assert sum(tally.inputs for tally in tallies.values()) == 20_000
    for name, tally in tallies.items():
        assert tally.problems == (), name
        assert tally.inputs / 10 < tally.read < tally.inputs * 0.9, name


def test_fuzzed_recordings_are_read_or_refused_by_row():
    tally = fuzz.fuzz_rows(1, 200)
    assert tally.problems == ()
    assert 0 < tally.read < 200


def test_reading_a_line_takes_memory_in_proportion_to_the_limit():
    limits = LineLimits(size=2**17, steps=2000)
    peaks = fuzz.largest_lines(limits)
    assert max(peaks.values()) < 30 * limits.size
    assert peaks["10 MB"] < 2**14


def test_mutated_archives_are_read_or_refused_by_file():
    tally = fuzz.fuzz_archives((f"mutated {i}", c) for i, c in enumerate(fuzz.mutated_archives(1, 300)))
    assert tally.problems == ()
    assert 0 < tally.read < 150


CRAFTED = fuzz.crafted_archives()


def test_crafted_archives_are_read_or_refused_by_file():
    assert len(CRAFTED) >= 200
    tally = fuzz.fuzz_archives(CRAFTED.items())
    assert tally.problems == ()
    assert tally.peak <= fuzz.LIMIT


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("a bomb of 1.5 GiB", r"its arrays take \d+ bytes; max_bytes is 1073741824"),
        ("a bomb of 3.9 GiB", r"its arrays take \d+ bytes; max_bytes is"),
        ("a bomb that claims to be small", "Bad CRC-32 for file 'features.npy'"),
        ("a vast array that claims to be small", "Bad CRC-32 for file 'features.npy'"),
        ("an unknown bomb", "an MDP archive has an unknown array 'reward'"),
        (f"features: shape ({2**70},)", rf"of shape \({2**70},\) must take {2**73} bytes"),
        ("features: type '<c16'", "'features' must hold real numbers or .*; got complex numbers"),
        ("objects", "'states' must hold text or integers; got objects"),
        ("flags 1", "'successors' is encrypted; arrays must be stored without a password"),
        ("method 14", "must be stored or deflated; its method of compression is number 14"),
        ("cut by 100", "not an MDP archive"),
        ("features twice", "an MDP archive has the array 'features' twice"),
        ("170000 entries", "its list of entries is longer than 131072 bytes"),
    ],
)
def test_a_refusal_says_what_is_wrong(what, message, tmp_path):
    (tmp_path / "m.npz").write_bytes(CRAFTED[what])
    with pytest.raises(StorageError, match=rf"m\.npz: .*{message}") as caught:
        load_mdp(tmp_path / "m.npz")
    assert "pickle" not in str(caught.value)


def test_a_header_of_minus_signs_is_refused(tmp_path):
    for what in CRAFTED:
        if re.search(r"header .*-{40}", what):
            (tmp_path / "m.npz").write_bytes(CRAFTED[what])
            with pytest.raises(StorageError, match="header of the array 'features'"):
                load_mdp(tmp_path / "m.npz")


def test_a_limit_can_be_raised_and_lowered(tmp_path):
    (tmp_path / "m.npz").write_bytes(fuzz.plain_archive())
    size = sum(len(content) for content in fuzz._entries(fuzz.plain_archive()).values())
    assert load_mdp(tmp_path / "m.npz", max_bytes=size).mdp.n_states == 3
    with pytest.raises(StorageError, match=f"its arrays take {size} bytes; max_bytes is {size - 1}"):
        load_mdp(tmp_path / "m.npz", max_bytes=size - 1)


def test_the_benchmark_reports_what_is_not_the_readers_own_error():
    def reader(line):
        if line == "a":
            raise KeyError(line)
        messages = {"b": "elsewhere", "c": "log, line 2: \x1b", "d": "log, line 2: x" * 90}
        raise DemonstrationError(messages[line])

    tally = fuzz._fuzzed("abcd", reader, DemonstrationError, "log, line 2")
    assert [p.split(":")[0] for p in tally.problems] == [f"input {i}" for i in (1, 2, 3, 4)]
    (problem,) = fuzz.fuzz_archives([("any", fuzz.plain_archive())], limit=1000).problems
    assert "bytes were allocated, the limit is" in problem
