import hashlib

import numpy as np
import pytest

from i2rl.domains.patrol.process import instance
from i2rl.models import StorageError, TabularMDP
from i2rl.models.observation.storage import load_mdp, save_mdp

# Digests of the patrols in journals older than exact starts.
PATROLS = {1: "c49075472716", 2: "2e475c8a9004", 3: "26d6963d4c83"}


def test_an_mdp_survives_the_file(tmp_path):
    patrol = instance(1)
    save_mdp(tmp_path / "m.npz", patrol.mdp, patrol.views[30])
    stored = load_mdp(tmp_path / "m.npz")
    assert stored.mdp.fingerprint() == patrol.mdp.fingerprint()
    assert stored.mdp.action_names == patrol.mdp.action_names
    assert np.array_equal(stored.in_view, patrol.views[30])


@pytest.mark.parametrize("number", PATROLS)
def test_a_patrol_has_its_old_digest_before_and_after_the_file(number, tmp_path):
    mdp = instance(number).mdp
    save_mdp(tmp_path / "m.npz", mdp)
    assert mdp.fingerprint().startswith(PATROLS[number])
    assert load_mdp(tmp_path / "m.npz").mdp.fingerprint() == mdp.fingerprint()


def started(initial):
    n = len(initial)
    return TabularMDP.from_successors(
        np.zeros((n, 1, 1), int), np.ones((n, 1, 1)), np.zeros((n, 1, 1)), initial=initial
    )


def test_what_is_loaded_is_what_was_saved_to_the_bit(tmp_path):
    rng = np.random.default_rng(0)
    starts = [rng.dirichlet(np.ones(n)) for n in rng.integers(2, 20, 300)]
    # Others sum to one only within the decimals they were written with, or within 32 bits.
    starts += [np.round(p, 8) for p in starts[:40] if abs(np.round(p, 8).sum() - 1) < 9e-9]
    starts += [p.astype(np.float32) for p in starts[:40]]
    for p in [np.full(6, 1 / 6), np.array([0.6, 0.3, 0.1]), *starts]:
        mdp = started(p)
        save_mdp(tmp_path / "m.npz", mdp)
        loaded = load_mdp(tmp_path / "m.npz").mdp
        assert np.asarray(loaded.initial).tobytes() == np.asarray(mdp.initial).tobytes()
        assert loaded.fingerprint() == mdp.fingerprint()
        assert started(np.asarray(mdp.initial)).fingerprint() == mdp.fingerprint()


def test_digests_are_those_of_divided_starts_as_journals_keep_them():
    rng = np.random.default_rng(1)
    for p in [np.full(6, 1 / 6), *(rng.dirichlet(np.ones(n)) for n in rng.integers(2, 20, 50))]:
        mdp = started(p)
        kept = hashlib.sha256()
        for leaf in (
            mdp.successors,
            mdp.probabilities,
            mdp.features,
            p / p.sum(),
            mdp.discount,
            mdp.available,
        ):
            array = np.ascontiguousarray(leaf)
            kept.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
        kept.update(repr((None, None, None)).encode())
        assert mdp.fingerprint() == kept.hexdigest()


def test_an_archive_needs_only_transitions_and_features(tmp_path):
    np.savez(
        tmp_path / "m.npz",
        successors=np.zeros((2, 1, 1), int),
        probabilities=np.ones((2, 1, 1)),
        features=np.ones((2, 1, 1)),
    )
    stored = load_mdp(tmp_path / "m.npz")
    assert stored.in_view is None
    assert np.allclose(stored.mdp.initial, 0.5)


def write_archive(path, **changes):
    arrays = {
        "successors": np.zeros((2, 1, 1), int),
        "probabilities": np.ones((2, 1, 1)),
        "features": np.ones((2, 1, 1)),
    } | changes
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"features": None}, "misses the array 'features'"),
        ({"reward": np.ones(2)}, "unknown array 'reward'"),
        ({"probabilities": np.full((2, 1, 1), 0.5)}, "sum to 1"),
        ({"in_view": np.ones(3)}, r"in_view must have shape \[2\]"),
        ({"states": np.array(["a", "a"])}, "repeated: 'a'"),
    ],
)
def test_errors_name_the_file_and_the_fault(tmp_path, changes, message):
    path = tmp_path / "world.npz"
    write_archive(path, **changes)
    with pytest.raises(ValueError, match=message) as caught:
        load_mdp(path)
    assert "world.npz" in str(caught.value)


def test_pickles_are_refused(tmp_path):
    write_archive(tmp_path / "m.npz", states=np.array([object(), object()], dtype=object))
    with pytest.raises(StorageError, match=r"m\.npz: the array 'states' must hold text .*; got objects"):
        load_mdp(tmp_path / "m.npz")


def test_a_file_that_is_no_archive_is_refused(tmp_path):
    (tmp_path / "m.npz").write_text("hello")
    with pytest.raises(ValueError, match="not an MDP archive"):
        load_mdp(tmp_path / "m.npz")


def test_a_truncated_archive_is_refused(tmp_path):
    path = tmp_path / "m.npz"
    write_archive(path)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match="not an MDP archive"):
        load_mdp(path)


@pytest.mark.parametrize(
    "change", [{"discount": np.ones(2)}, {"states": np.array("a")}, {"in_view": [np.nan, 1]}]
)
def test_arrays_of_the_wrong_kind_name_the_file(tmp_path, change):
    write_archive(tmp_path / "world.npz", **change)
    with pytest.raises(ValueError, match=r"world\.npz"):
        load_mdp(tmp_path / "world.npz")
