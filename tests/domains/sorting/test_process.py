"""The processes of onion sorting against the published tables, re-derived here from their text."""

from functools import cache

import jax
import numpy as np
import pytest
from scipy import stats

from i2rl.domains.sorting.process import (
    FEATURES,
    Sorting,
    State,
    demonstrate_sorting,
    pick_inspect_place,
    sorting_with_claiming,
    sorting_without_claiming,
)
from i2rl.models import TabularMDP
from i2rl.models.process.planning import hard_plan, policy_values, reward_of

PIP, RPP, STAY = range(3)
INSPECT, TO_CONVEYOR, TO_BIN, PICK, NEW, ROLL, LISTED = range(7)
LETTERS = "ICBPNRL"

S23 = (  # noqa: SIM905 (as printed)
    "0200 3230 1012 2222 0222 3232 1112 0001 3031 2221 0021 2220 0202 0220 0100 0110 0120 0130 0210 0230 "
    "3130 0011 0031"
).split()
S26 = [*S23, "4202", "0212", "0232"]
S22 = (
    [f"0{p}{h}2" for p in range(3) for h in range(4)]
    + [f"3{p}32" for p in range(3)]
    + [f"1{p}12" for p in range(3)]
    + [f"22{h}2" for h in range(4)]
)
STARTS = ["0200", "0220", "0100", "0110", "0120", "0130", "0210", "0230"]

RAW_PIP = np.array([2, 1, 2, 1, 0.2, 0.1, 0, 4, 0, 0, 4])
RAW_RPP = np.array([0, 4, 0, 4, 0.2, 0, 8, 0, 8, 4, 0])
RAW_PIP_ALONE = np.array([2, 2, 2, 2, 0.2, 0.1, 0, 4, 0, 0, 4])
THETA_STAY = np.eye(11)[5]


def outcomes(s: str, a: int) -> list[tuple[str, float]]:
    """Intended outcomes of an action, states as four digits (onion, prediction, hand, list)."""
    _, p, h, ls = s
    known = p != "2"
    if a == INSPECT:
        return [(f"1{p}1{ls}", 1.0)] if known else [("1112", 0.5), ("1012", 0.5)]
    if a == TO_CONVEYOR:
        return [("0202", 1.0)]
    if a == TO_BIN:
        return [("2221", 0.5), ("2220", 0.5)] if ls == "1" else [(f"222{ls}", 1.0)]
    if a == PICK:
        return [(f"3{p}3{ls}", 1.0)]
    if a == NEW:
        return [(f"02{h}2", 1.0)]
    if a == ROLL:
        return [(f"00{h}1", 0.95), (f"02{h}0", 0.05)]
    return [(f"00{h}1", 1.0)] if ls == "1" else [(f"02{h}{ls}", 1.0)]


def offered(s: str, table: dict[str, str]) -> str:
    """Letters of the actions a state offers; ``table`` says what differs between the processes."""
    onion, p, _, ls = s
    if onion == "0":
        if ls == "1":
            return "L" if p == "2" else "P"
        return table["empty"] if ls == "0" else table["none"]
    if onion == "3":
        return {"2": "I", "0": "B", "1": "C"}[p]
    if onion == "1":
        return table["inspected"] if p != "2" and table["inspected"] else {"2": "I", "0": "B", "1": "C"}[p]
    return {"2": "N", "0": "R", "1": "L"}[ls]


A23 = {"empty": "RP", "none": "P", "inspected": ""}
A26 = {"empty": "RPN", "none": "PN", "inspected": ""}
A22 = {"empty": "", "none": "PN", "inspected": "CB"}


def code_features(s: str, n: str) -> list[bool]:
    (o, p, _, ls), (o2, p2, h2, ls2) = s, n
    return [
        p == "1" and o2 == "0",
        p == "0" and o2 != "0",
        p == "1" and o2 != "2",
        p == "0" and o2 == "2",
        n != s,
        p2 == "2" and o2 == "0",
        ls == "0" and ls2 == "1",
        o == "0" and p == "2" and p2 == "2" and h2 == "3",
        o == "0" and p == "0" and p2 == "0" and h2 == "3",
        ls == "1" and ls2 == "0",
        o == "3" and p == "2" and p2 != "2",
    ]


def action_features(s: str, a: int, n: str) -> list[bool]:
    fired = code_features(s, n)
    fired[0] = fired[0] and a == TO_CONVEYOR
    fired[5] = a == NEW
    # On the outcome: a slip leaves the onion where it was, and nothing is picked.
    fired[7] = a == PICK and s[:2] == "02" and n[0] == "3"
    fired[8] = a == PICK and s[:2] == "00" and n[0] == "3"
    return fired


@cache
def derived(states: tuple[str, ...], which: str, coded: bool) -> tuple[np.ndarray, ...]:
    """Kernel, features of intended outcomes and of what happens, and what is offered."""
    table = {"23": A23, "26": A26, "22": A22}[which]
    size = len(states), len(LETTERS)
    kernel, offers = np.zeros((*size, len(states))), np.zeros(size, bool)
    intended, happening = np.zeros((2, *size, len(FEATURES)))
    for i, s in enumerate(states):
        for letter in offered(s, table):
            a = LETTERS.index(letter)
            offers[i, a] = True

            def phi(n: str, s: str = s, a: int = a) -> np.ndarray:
                return np.array(code_features(s, n) if coded else action_features(s, a, n), float)

            for n, chance in outcomes(s, a):
                kernel[i, a, states.index(n)] += 0.95 * chance
                kernel[i, a, i] += 0.05 * chance
                intended[i, a] += chance * phi(n)
                happening[i, a] += chance * (0.95 * phi(n) + 0.05 * phi(s))
    return kernel, intended, happening, offers


def derived_mdp(states: list[str], which: str, coded: bool) -> TabularMDP:
    kernel, intended, _, offers = derived(tuple(states), which, coded)
    return TabularMDP.from_dense(kernel, intended, discount=0.99, available=offers)


def choices(mdp: TabularMDP, states: list[str], weights: np.ndarray) -> dict[str, str]:
    """Return the optimal action's letter in every state; fail on a tie."""
    optimal = np.asarray(_plan(mdp, weights).optimal)
    assert (optimal.sum(1) == 1).all()
    return dict(zip(states, (LETTERS[a] for a in optimal.argmax(1)), strict=True))


@jax.jit
def _plan(mdp, weights):
    return hard_plan(mdp, reward_of(mdp, weights))


def codes(sorting: Sorting) -> list[str]:
    return ["".join(map(str, row)) for row in sorting.factors]


PROCESSES = {
    "with claiming": (sorting_with_claiming, S26, "26", False),
    "without claiming": (sorting_without_claiming, S23, "23", True),
    "pick-inspect-place": (pick_inspect_place, S22, "22", False),
}


@pytest.mark.parametrize("process", PROCESSES)
def test_the_process_is_the_published_one(process):
    build, states, which, coded = PROCESSES[process]
    sorting = build()
    ours = codes(sorting)
    assert sorted(ours) == sorted(states)
    order = [states.index(s) for s in ours]
    kernel, intended, happening, offers = (x[order] for x in derived(tuple(states), which, coded))
    mdp = sorting.mdp
    dense = np.stack([np.asarray(mdp.transition_probability(z)) for z in range(len(ours))], axis=-1)
    np.testing.assert_allclose(dense, kernel[..., order], atol=1e-15)
    np.testing.assert_array_equal(np.asarray(mdp.available), offers)
    np.testing.assert_allclose(np.asarray(mdp.features), intended, atol=1e-15)
    np.testing.assert_allclose(sorting.transition_features, happening, atol=1e-15)
    # Closed: every action that is offered leads to a state of the list.
    np.testing.assert_allclose(dense.sum(-1), offers.astype(float), atol=1e-12)
    assert float(mdp.discount) == 0.99
    assert mdp.action_names[ROLL] == "roll"


@pytest.mark.parametrize(
    ("build", "n_states", "pairs", "choosing"),
    [
        (sorting_without_claiming, 23, 31, 8),
        (sorting_with_claiming, 26, 46, 12),
        (pick_inspect_place, 22, 36, 14),
    ],
)
def test_counts(build, n_states, pairs, choosing):
    mdp = build().mdp
    assert mdp.n_states == n_states
    assert int(mdp.available.sum()) == pairs
    assert int((mdp.available.sum(1) > 1).sum()) == choosing
    assert mdp.n_features == 11


@pytest.mark.parametrize("build", [sorting_with_claiming, sorting_without_claiming])
def test_sorters_start_before_any_list(build):
    sorting = build()
    starting = dict(zip(codes(sorting), np.asarray(sorting.mdp.initial), strict=True))
    assert {s for s, p in starting.items() if p > 0} == set(STARTS)
    np.testing.assert_allclose([starting[s] for s in STARTS], 1 / 8)


def test_the_lone_picker_starts_with_an_unknown_onion():
    sorting = pick_inspect_place()
    starting = dict(zip(codes(sorting), np.asarray(sorting.mdp.initial), strict=True))
    assert {s for s, p in starting.items() if p > 0} == {"0202", "0212", "0222", "0232"}


def test_true_weights():
    with_claiming = sorting_with_claiming()
    printed = np.array([
        [.13986, .06993, .13986, .06993, .013986, .006993, 0, .27972, 0, 0, .27972],
        [0, .141844, 0, .141844, .0070922, 0, .283688, 0, .283688, .141844, 0],
        [0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0],
    ])  # fmt: skip
    np.testing.assert_allclose(with_claiming.weights, printed, atol=5e-6)
    np.testing.assert_array_equal(sorting_without_claiming().weights, with_claiming.weights)
    np.testing.assert_allclose(pick_inspect_place().weights, [RAW_PIP_ALONE / 16.3])
    for build, *_ in PROCESSES.values():
        sorting = build()
        np.testing.assert_allclose(np.abs(sorting.weights).sum(1), 1)
        assert len(sorting.behaviours) == len(sorting.weights)


# -- what sorters do ----------------------------------------------------------------------------------

FORCED = {
    "3230": "I",
    "3232": "I",
    "1012": "B",
    "3031": "B",
    "1112": "C",
    "3130": "C",
    "2222": "N",
    "2221": "L",
    "2220": "R",
    "0001": "P",
    "0021": "P",
    "0011": "P",
    "0031": "P",
}


def policy_of(sorting: Sorting, behaviour: int) -> dict[str, str]:
    policy = sorting.expert_policy(behaviour)
    assert set(np.unique(policy)) == {0, 1}
    return dict(zip(codes(sorting), (LETTERS[a] for a in policy.argmax(1)), strict=True))


@pytest.mark.parametrize(("behaviour", "empty"), [(PIP, "P"), (RPP, "R"), (STAY, "P")])
def test_policies_without_claiming(behaviour, empty):
    policy = policy_of(sorting_without_claiming(), behaviour)
    assert policy == FORCED | {"0222": "P", "0202": "P"} | dict.fromkeys(STARTS, empty)


@pytest.mark.parametrize("process", PROCESSES)
def test_no_expert_is_torn_between_actions(process):
    sorting = PROCESSES[process][0]()
    for behaviour, weights in enumerate(sorting.weights):
        assert choices(sorting.mdp, codes(sorting), weights) == policy_of(sorting, behaviour)


def test_claiming_cannot_be_expressed_on_23_states():
    sorting = sorting_without_claiming()
    assert policy_of(sorting, STAY) == policy_of(sorting, PIP)
    assert accuracy(sorting, PIP, RPP) == 15 / 23


@pytest.mark.parametrize(("behaviour", "empty", "none"), [(PIP, "P", "P"), (RPP, "R", "P"), (STAY, "N", "N")])
def test_policies_with_claiming(behaviour, empty, none):
    policy = policy_of(sorting_with_claiming(), behaviour)
    choosing = dict.fromkeys(STARTS, empty) | dict.fromkeys(["0202", "0222", "0212", "0232"], none)
    assert policy == FORCED | {"4202": "N"} | choosing


def accuracy(sorting: Sorting, one: int, other: int) -> float:
    first, second = policy_of(sorting, one), policy_of(sorting, other)
    return np.mean([first[s] == second[s] for s in first])


@pytest.mark.parametrize(
    ("pair", "printed"), [((PIP, RPP), 0.692), ((PIP, STAY), 0.538), ((RPP, STAY), 0.538)]
)
def test_accuracy_between_behaviours(pair, printed):
    assert accuracy(sorting_with_claiming(), *pair) == pytest.approx(printed, abs=5e-4)


def test_policy_of_the_lone_picker():
    sorting = pick_inspect_place()
    table = {f"0{p}{h}2": "N" if p == 0 else "P" for p in range(3) for h in range(4)}
    bins = {f"22{h}2": "N" for h in range(4)}
    places = {"3232": "I", "3032": "B", "3132": "C", "1212": "I", "1012": "B", "1112": "C"}
    assert policy_of(sorting, 0) == table | bins | places
    # Eight states are ever met.
    chain = np.asarray(sorting.mdp.state_transitions(sorting.expert_policy(0)))
    met = np.asarray(sorting.mdp.initial) > 0
    for _ in range(len(met)):
        met |= met @ chain > 0
    ours = {s for s, m in zip(codes(sorting), met, strict=True) if m}
    assert ours == {"0202", "0212", "0222", "0232", "3232", "1012", "1112", "2222"}


def test_margins_of_the_lone_picker():
    sorting = pick_inspect_place()
    mdp = sorting.mdp
    plan = _plan(mdp, sorting.weights[0])
    q = np.where(
        mdp.available, reward_of(mdp, sorting.weights[0]) + 0.99 * mdp.expect_next(plan.values), np.nan
    )
    ordered = np.sort(np.where(np.isnan(q), -np.inf, q), axis=1)
    margin = dict(zip(codes(sorting), ordered[:, -1] - ordered[:, -2], strict=True))
    printed = {"1112": 0.449, "1012": 0.042}
    printed |= {f"0{p}{h}2": m for p, m in ((2, 0.218), (0, 0.052), (1, 0.027)) for h in range(4)}
    assert {s: margin[s] for s in printed} == pytest.approx(printed, abs=5e-4)
    assert {s for s, m in margin.items() if np.isfinite(m)} == set(printed)


# -- traps of the released code ------------------------------------------------------------------------


def test_the_first_weights_put_blemished_onions_back():
    policy = choices(pick_inspect_place().mdp, codes(pick_inspect_place()), RAW_PIP / 14.3)
    assert policy["1012"] == "C"


def test_outcome_features_make_the_lone_picker_claim_for_ever():
    policy = choices(derived_mdp(S22, "22", True), S22, RAW_PIP_ALONE / 16.3)
    assert policy["0232"] == "N"
    assert {s: policy[s] for s in S22 if s[:2] in ("00", "01")} == {
        s: "N" for s in S22 if s[:2] in ("00", "01")
    }
    assert (policy["1012"], policy["1112"]) == ("B", "C")


def test_outcome_features_make_the_claiming_picker_claim_for_ever():
    coded = derived_mdp(S26, "26", True)
    differs = {"0100", "0110", "0120", "0130", "0230", "0232"}
    meant = policy_of(sorting_with_claiming(), PIP)
    policy = choices(coded, S26, RAW_PIP / 14.3)
    assert {s for s in S26 if policy[s] != meant[s]} == differs
    assert {policy[s] for s in differs} == {"N"}
    assert choices(coded, S26, RAW_RPP / 28.2) == policy_of(sorting_with_claiming(), RPP)
    assert choices(coded, S26, THETA_STAY) == policy_of(sorting_with_claiming(), STAY)


def test_loopholes_of_outcome_features():
    sorting = sorting_without_claiming()
    at = {s: i for i, s in enumerate(codes(sorting))}
    features = np.asarray(sorting.mdp.features)
    # "Claims a new onion" fires when one is put back and, in one of twenty, when rolling finds nothing.
    assert features[at["1112"], TO_CONVEYOR, 5] == 1
    assert features[at["0200"], ROLL, 5] == pytest.approx(0.05)
    # "Good on table" fires on rolling while a good onion is claimed.
    assert features[at["0100"], ROLL, 0] == 1
    # "Picks unknown" fires on a fruitless roll with the hand up, and on a claim there.
    assert features[at["0230"], ROLL, 7] == pytest.approx(0.05)
    claiming = sorting_with_claiming()
    where = codes(claiming).index("0230")
    assert derived(tuple(S26), "26", True)[1][S26.index("0230"), NEW, 7] == 1
    assert claiming.mdp.features[where, NEW, 7] == 0
    assert claiming.mdp.features[where, ROLL, 7] == 0
    assert claiming.mdp.features[codes(claiming).index("1112"), TO_CONVEYOR, 5] == 0


# -- check numbers -------------------------------------------------------------------------------------

# Expected features over 50 steps, theta . E, and mean value from the start, as printed.
PRINTED = [
    (
        sorting_without_claiming,
        PIP,
        "7.067 6.885 7.938 6.541 47.5 14.157 0 13.66 0 0 13.367",
        "11.361",
        "23.651",
    ),
    (
        sorting_without_claiming,
        RPP,
        ".526 31.845 .526 15.356 47.453 .497 8.504 .014 15.693 7.678 0",
        "14.985",
        "31.237",
    ),
    (
        sorting_with_claiming,
        PIP,
        "7.041 6.885 7.938 6.541 47.5 6.735 0 13.653 0 0 13.367",
        "11.303",
        "23.549",
    ),
    (sorting_with_claiming, RPP, "0 31.845 .526 15.356 47.453 0 8.504 0 15.68 7.678 0", "14.981", "31.237"),
    (sorting_with_claiming, STAY, "0 0 .526 0 1.0 50 0 0 0 0 0", "50.0", "100.0"),
]


def to_the_printed_digits(values, printed: str):
    """Assert that values, rounded as the printed numbers are, are those numbers."""
    for value, text in zip(np.ravel(values), printed.split(), strict=True):
        digits = len(text.partition(".")[2])
        assert abs(value - float(text)) <= 0.5000001 * 10**-digits if digits else 5e-4, (value, text)


def expected_features(sorting: Sorting, policy: np.ndarray, steps: int) -> np.ndarray:
    chain = np.asarray(sorting.mdp.state_transitions(policy))
    per_state = np.einsum("sa,sak->sk", policy, sorting.transition_features)
    state, total = np.asarray(sorting.mdp.initial), 0.0
    for _ in range(steps):
        total, state = total + state @ per_state, state @ chain
    return np.asarray(total)


@pytest.mark.parametrize(("build", "behaviour", "features", "worth", "value"), PRINTED)
def test_check_numbers(build, behaviour, features, worth, value):
    sorting = build()
    expected = expected_features(sorting, sorting.expert_policy(behaviour), 50)
    to_the_printed_digits(expected, features)
    to_the_printed_digits(sorting.weights[behaviour] @ expected, worth)
    plan = _plan(sorting.mdp, sorting.weights[behaviour])
    to_the_printed_digits(sorting.mdp.initial @ plan.values, value)


@pytest.mark.parametrize(
    ("true", "norm", "losses"),
    [
        (PIP, "552.2", {RPP: "168.7", STAY: "501.3"}),
        (RPP, "520.5", {PIP: "294.0", STAY: "397.5"}),
        (STAY, "2200.7", {PIP: "1889.6", RPP: "2043.9"}),
    ],
)
def test_losses_between_behaviours(true, norm, losses):
    sorting = sorting_with_claiming()
    reward = reward_of(sorting.mdp, sorting.weights[true])
    best = np.asarray(_plan(sorting.mdp, sorting.weights[true]).values)
    to_the_printed_digits(best.sum(), norm)
    for behaviour, printed in losses.items():
        values = np.asarray(policy_values(sorting.mdp, sorting.expert_policy(behaviour), reward))
        to_the_printed_digits(np.abs(best - values).sum(), printed)


# -- demonstrations ------------------------------------------------------------------------------------


@cache
def demonstrated():
    return demonstrate_sorting(jax.random.key(3), sorting_with_claiming(), (300, 300, 0), steps=50)


def test_demonstrated_frequencies_are_the_process():
    sorting = sorting_with_claiming()
    demonstration, labels = demonstrated()
    np.testing.assert_array_equal(labels, np.repeat([PIP, RPP], 300))
    states, actions = np.asarray(demonstration.state), np.asarray(demonstration.action)
    assert states.shape == (600, 50)
    for behaviour in (PIP, RPP):
        mine = labels == behaviour
        np.testing.assert_array_equal(
            sorting.expert_policy(behaviour)[states[mine], actions[mine]], np.ones((300, 50))
        )
    starts = np.bincount(states[:, 0], minlength=26)[np.asarray(sorting.mdp.initial) > 0]
    assert stats.chisquare(starts).pvalue > 1e-3
    kernel = derived(tuple(S26), "26", False)[0]
    place = [S26.index(s) for s in codes(sorting)]
    counted = np.zeros(kernel.shape)
    for s, a, n in zip(states[:, :-1].ravel(), actions[:, :-1].ravel(), states[:, 1:].ravel(), strict=True):
        counted[place[s], a, place[n]] += 1
    assert not counted[kernel == 0].any()
    surprises = []
    for s, a in np.argwhere(counted.sum(-1) > 200):
        possible = kernel[s, a] > 0
        if possible.sum() > 1:
            expected = kernel[s, a][possible] * counted[s, a].sum()
            surprises.append(stats.chisquare(counted[s, a][possible], expected).pvalue)
    assert len(surprises) >= 8
    # The least of so many uniform draws.
    assert min(surprises) > 1e-3 / len(surprises)


def test_demonstrated_features_average_to_the_check_numbers():
    sorting = sorting_with_claiming()
    demonstration, labels = demonstrated()
    sums = sorting.transition_features[demonstration.state, demonstration.action].sum(1)
    for behaviour, (_, _, printed, _, _) in ((PIP, PRINTED[2]), (RPP, PRINTED[3])):
        mine = sums[labels == behaviour]
        error = mine.std(0, ddof=1) / np.sqrt(len(mine))
        expected = np.array([float(x) for x in printed.split()])
        # What hardly varies differs by the rounding of the printed number only.
        assert (np.abs(mine.mean(0) - expected) < 4 * error + 1e-3).all()


def test_the_same_key_gives_the_same_sorters():
    again = demonstrate_sorting(jax.random.key(3), sorting_with_claiming(), (300, 300, 0), steps=50)
    other = demonstrate_sorting(jax.random.key(4), sorting_with_claiming(), (300, 300, 0), steps=50)
    first = demonstrated().demonstration
    np.testing.assert_array_equal(again.demonstration.codes, first.codes)
    assert (other.demonstration.codes != first.codes).any()


@pytest.mark.parametrize(
    ("counts", "steps", "complaint"),
    [
        ((1, 1, 1, 1), 5, "counts"),
        ((), 5, "counts"),
        ((0, 0, 0), 5, "not all zero"),
        ((2, -1), 5, "non-negative"),
        ((2,), 0, "at least one step"),
    ],
)
def test_bad_counts(counts, steps, complaint):
    with pytest.raises(ValueError, match=complaint):
        demonstrate_sorting(jax.random.key(0), sorting_with_claiming(), counts, steps)


def test_names_of_states():
    assert State(0, 2, 3, 0).name == "unknown on the table, hovering, list empty"
    sorting = sorting_with_claiming()
    assert sorting.mdp.state_names == tuple(state.name for state in sorting.states)
