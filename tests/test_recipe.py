"""What a result says of its settings: all that acted, as it was, and nothing else."""

import inspect
import sys

import numpy as np
import pytest

from phytofit import fit, from_points, load_species, simulate
from phytofit.recipe import STEPS, recipe, recipe_of

GIVEN = {
    "likelihood": {
        "n_samples": 31, "n_points": 380, "n_generations": 3, "elite_fraction": 0.2, "covariance_noise": 0.4,
        "random_start": True, "seed": 5, "up": "z", "seed_point": [[1.0, 2.0, 3.0]],
    },
    "paper": {
        "n_samples": 32, "n_points": 300, "n_generations": 2, "elite_fraction": 0.3, "covariance_noise": 0.3,
        "random_start": True, "seed": 6, "up": "-z", "distance": "quantile",
    },
}  # fmt: skip
NOT_STORED = {"cloud", "units", "species", "threads", "progress"}  # the input, a name, and what does not act


@pytest.fixture(scope="module", params=GIVEN)
def made(request):
    """A result with every option changed, what it was given, and with what the steps ran on the way."""
    given = dict(GIVEN[request.param])
    phytomer = simulate(load_species(), n_points=400, noise_cm=0.2, random_orientation=False, seed=2)
    if "seed_point" in given:
        given["seed_point"] = [phytomer.organs[1].axis[len(phytomer.organs[1].axis) // 2].tolist()]
    if "stem_above" in inspect.signature(fit).parameters and request.param == "paper":
        default = inspect.signature(fit).parameters["stem_above"].default
        given["stem_above"] = "none" if isinstance(default, str | None) else not default
    codes = {_code(function): step for step, function in STEPS.items()}
    ran = {}

    def see(frame, event, _):
        if event == "call" and frame.f_code in codes:
            ran[codes[frame.f_code]] = dict(frame.f_locals)

    before = sys.getprofile()
    sys.setprofile(see)
    try:
        result = fit(from_points(phytomer.points, "cm"), method=request.param, threads=1, **given)
    finally:
        sys.setprofile(before)
    return result, {**given, "method": request.param}, ran


def _code(function):
    return (function.__init__ if inspect.isclass(function) else function).__code__


def test_every_option_is_stored_as_it_was_used(made):
    result, given, _ = made
    used = recipe_of(result)["fit"]
    for name, value in given.items():
        if name == "up":
            assert used["up"] == [0.0, 0.0, 1.0 if value == "z" else -1.0]
        else:
            assert used[name] == value, name
    missing = set(inspect.signature(fit).parameters) - NOT_STORED - set(used)
    assert missing <= {"distance"}  # that only the paper's method has


def test_what_is_stored_of_a_step_is_what_it_ran_with(made):
    """And nothing of a step that did not run; the objective of the default method is that of its short search."""
    result, _, ran = made
    stored = recipe_of(result)
    in_stored = {"objective": "search" if result.method == "likelihood" else "objective"}
    named = {in_stored.get(step, step): arguments for step, arguments in ran.items()}
    assert set(stored) <= set(named)
    for step, settings in stored.items():
        for name, value in settings.items():
            if step != "fit":
                assert named[step][name] == value, (step, name)
    acted = {step for step in recipe() if step in named and not step.startswith(("method_", "fit"))}
    assert acted <= set(stored) | {"thin"}  # whose only setting is one of fit's


def test_a_recipe_repeats_the_run(made):
    result, _, _ = made
    used = {k: v for k, v in recipe_of(result)["fit"].items() if k != "species"}
    again = fit(from_points(simulate_again(), "cm"), threads=2, **used)
    np.testing.assert_array_equal(again.x, result.x)


def simulate_again():
    return simulate(load_species(), n_points=400, noise_cm=0.2, random_orientation=False, seed=2).points
