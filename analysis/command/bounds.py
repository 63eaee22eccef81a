"""``i2rl bounds``: numbers of demonstrations that are enough."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from ..drawing.results import plain
from .console import output_console, reported_errors
from .options import Json, count_option, real_option


def print_bounds(
    features: Annotated[int | None, count_option("Number of reward features, K.", most=10**6)] = None,
    epsilon: Annotated[
        float, real_option("Error of a feature's discounted average, below 1.", 1e-9, 1)
    ] = 0.1,
    confidence: Annotated[float, real_option("Probability with which the bound holds.", 0, 1)] = 0.8,
    epsilon_s: Annotated[float, real_option("Error of sampling the hidden steps, below 1.", 1e-9, 1)] = 0.05,
    discount: Annotated[float | None, real_option("Discount, below 1; 0.99 without --mdp.", 0, 1)] = None,
    deviation: Annotated[
        float | None, real_option("Standard deviation of the features' discounted averages.", 0, 0.5)
    ] = None,
    mdp: Annotated[
        str | None, typer.Option(help="patrol1, patrol2 or patrol3: its features, discount and spread.")
    ] = None,
    predicates: Annotated[
        int | None, count_option("Predicates whose reliabilities describe noisy perception.")
    ] = None,
    steps: Annotated[int | None, count_option("Steps of a trajectory, with --predicates.")] = None,
    as_json: Json = False,
) -> None:
    """Compute how many demonstrations are enough, by the theorem and tighter bounds; list the assumptions."""
    from ..bounds import sample_sizes as bounds_answer

    with reported_errors():
        answer = bounds_answer.answer(
            features,
            epsilon,
            confidence,
            epsilon_s,
            discount,
            deviation,
            mdp,
            bounds_answer.PerceptionSize(predicates, steps),
        )
    if as_json:
        print(json.dumps(plain(bounds_answer.summary(answer))))
    else:
        bounds_answer.print_answer(answer, output_console())
