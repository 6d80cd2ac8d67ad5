"""Dependence of neighbours' errors: none where there is none, and what there is as simulations of it have it."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from phytofit.engine.dependence import (
    NONE,
    GaussianCorrelation,
    _before_the_fit,
    _correlation,
    score_dependence,
    width_misfit,
)
from phytofit.engine.layout import State
from phytofit.engine.posterior import Posterior
from phytofit.engine.refine import refinement
from phytofit.models import SurfaceSampler, move
from phytofit.species import load_species

SAME = 1e-9  # relative; sums in float64
REACH = 0.4  # relative; what a few hundred points tell of a correlation's reach
HEIGHT = 0.25  # the same of its height
FACTOR = 1.4  # of an inflation: of both its estimate and the simulations that it is held against
INDEFINITE = 0.1  # of the variance of independent points: the bell is cut off where it is 0.04
CELLS = 0.15  # relative; neighbours are counted by cells that stay where they are when the cloud is turned

SPECIES = load_species()
X = np.array([3.2, 14.0, 42.0, 54.0, 6.5, 3.4, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 2.0])
NOISE_CM = 0.3


def smooth_noise(places, width_cm, share, random):
    """Normal errors (n, 3) of variance 1, a share of it white noise averaged over the places' neighbours.

    White noise that a bell of some width has averaged is correlated over a bell that is wider by the root of 2.
    """
    white = random.normal(size=places.shape)
    weight = np.exp(-0.5 * (cdist(places, places) / width_cm) ** 2)
    weight /= np.linalg.norm(weight, axis=1, keepdims=True)
    return np.sqrt(share) * weight @ random.normal(size=places.shape) + np.sqrt(1.0 - share) * white


def scene(seed, *, n=600, k=7, width_cm=1.0, share=0.0, noise_cm=NOISE_CM):
    """The likelihood of a cloud of the phytomer X, whose errors are averages by `share`, and its true state."""
    random = np.random.default_rng(seed)
    species = SPECIES.leading(k)
    stem, leaf = organs = [organ.row(0) for organ in species.model.organs(X[:k])]
    points, _ = SurfaceSampler(n, seed, even=False).draw(organs)
    errors = smooth_noise(points, width_cm, share, random) if share else random.normal(size=points.shape)
    likelihood = Posterior.of(species, points + noise_cm * errors)
    state = likelihood.start(X[:k], np.eye(4), noise_cm)
    state.theta[-2:] = np.log(stem.area / leaf.area), np.log(0.01)
    return likelihood, state


def fitted(likelihood, state):
    """The state where the likelihood is greatest: its errors are what a fit leaves of the true ones."""
    return likelihood, state.at(refinement(likelihood, state).theta)


def in_standard_errors(likelihood, state, variability):
    """A covariance (k, k) of the scores' sum, with the prior's, in units of that of independent points."""
    scores = likelihood.evaluate(state).scores
    root = np.linalg.cholesky(scores.T @ scores + np.diag(likelihood.prior.precision + 1e-9))
    whole = variability + np.diag(likelihood.prior.precision)
    return np.linalg.solve(root, np.linalg.solve(root, whole).T)


# a cloud


@pytest.mark.parametrize("k", [7, 19])
@pytest.mark.parametrize("seed", range(4))
def test_independent_errors_inflate_nothing(seed, k):
    likelihood, state = scene(seed, k=k)
    found = score_dependence(likelihood, state)
    assert (found.inflation, found.stem, found.leaf) == (1.0, NONE, NONE)
    scores = likelihood.evaluate(state).scores
    np.testing.assert_allclose(found.variability, scores.T @ scores, rtol=SAME)


@pytest.mark.parametrize(("seed", "k"), [(1, 7), (2, 7), (3, 7), (2, 19)])
def test_errors_of_neighbours_are_found_to_be_correlated(seed, k):
    likelihood, state = fitted(*scene(seed, n=800, k=k, width_cm=1.0, share=1.0))
    found = score_dependence(likelihood, state)
    assert found.leaf.reach_cm == pytest.approx(np.sqrt(2.0), rel=REACH)
    assert found.leaf.correlation == pytest.approx(1.0, abs=HEIGHT)
    assert found.inflation > 2.0


@pytest.mark.long
def test_the_inflation_is_that_of_many_clouds():
    """Of clouds of one phytomer: so many times more do sums of scores vary than those of independent points."""
    sums, estimates, independent = [], [], 0.0
    for seed in range(100, 200):
        likelihood, state = scene(seed, n=300, width_cm=1.0, share=1.0)
        scores = likelihood.evaluate(state).scores
        sums.append(scores.sum(axis=0))
        independent += scores.T @ scores / 100.0
        if seed % 10 == 0:
            estimates.append(score_dependence(*fitted(likelihood, state)).inflation)
    prior = np.diag(likelihood.prior.precision)
    varied = np.linalg.solve(independent + prior + 1e-9 * np.eye(len(prior)), np.cov(np.transpose(sums)) + prior)
    inflation = np.trace(varied) / len(prior)
    assert inflation > 2.0
    assert inflation / FACTOR < np.median(estimates) < inflation * FACTOR


def test_more_and_wider_correlation_inflates_more():
    settings = [(0.5, 0.5), (0.5, 1.0), (1.0, 1.0), (2.0, 1.0)]
    found = [score_dependence(*fitted(*scene(2, width_cm=width, share=share))).inflation for width, share in settings]
    assert np.all(np.diff(found) > 0.0)


def test_twice_the_points_of_the_same_places_know_little_more():
    """Within a correlated patch, points repeat each other: the variance grows as their square."""
    few, many = (
        np.mean([score_dependence(*scene(seed, n=n, width_cm=1.0, share=1.0)).inflation for seed in range(5, 11)])
        for n in (400, 800)
    )
    assert 1.4 < many / few < 2.8


@pytest.mark.parametrize("k", [7, 19])
@pytest.mark.parametrize("share", [0.5, 1.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_variability_is_a_covariance(seed, share, k):
    """Symmetric, and no combination of parameters has a negative variance to speak of."""
    likelihood, state = scene(seed, k=k, width_cm=1.0, share=share)
    found = score_dependence(likelihood, state)
    assert found.inflation > 1.0
    whole = in_standard_errors(likelihood, state, found.variability)
    np.testing.assert_allclose(whole, whole.T, atol=SAME * np.abs(whole).max())
    values = np.linalg.eigvalsh(whole)
    assert values[0] > -INDEFINITE
    assert values.mean() == pytest.approx(found.inflation, rel=1e-6)


def test_a_cloud_may_lie_anywhere():
    likelihood, state = scene(2, width_cm=1.0, share=1.0)
    there = np.eye(4)
    there[:3, :3] = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    there[:3, 3] = [300.0, -200.0, 100.0]
    moved = likelihood.at(likelihood.points @ there[:3, :3].T + there[:3, 3])
    turned = State(state.theta, state.layout, there @ state.pose, there[:3, :3] @ state.center + there[:3, 3])
    here, away = score_dependence(likelihood, state), score_dependence(moved, turned)
    assert away.leaf.reach_cm == here.leaf.reach_cm
    assert away.leaf.correlation == pytest.approx(here.leaf.correlation, rel=1e-6)
    assert away.inflation == pytest.approx(here.inflation, rel=CELLS)


def test_what_it_is_asked_of_stays_as_it_was():
    likelihood, state = scene(2, n=300, width_cm=1.0, share=1.0)
    points, theta = likelihood.points.copy(), state.theta.copy()
    first, second = (score_dependence(likelihood, state) for _ in range(2))
    np.testing.assert_array_equal(likelihood.points, points)
    np.testing.assert_array_equal(state.theta, theta)
    assert first.variability.tobytes() == second.variability.tobytes()


def test_misfit_counts_as_correlation():
    """A leaf whose side bend the model lacks lies off it in long stretches."""
    random = np.random.default_rng(3)
    bent = X.copy()
    bent[10] = 15.0
    bent[12] = 10.0
    species = SPECIES.leading(7)
    organs = move([organ.row(0) for organ in SPECIES.model.organs(bent)], np.eye(4))
    points, _ = SurfaceSampler(600, 3, even=False).draw(organs)
    points += random.normal(0.0, NOISE_CM, points.shape)
    likelihood = Posterior.of(species, points)
    found = score_dependence(*fitted(likelihood, likelihood.start(X[:7], np.eye(4), 2.0 * NOISE_CM)))
    assert found.leaf.reach_cm > 1.0
    assert found.inflation > 2.0


def test_stem_and_leaf_are_correlated_each_by_itself():
    """Errors of the leaf alone that are averages: the stem's diameter is as sure as it was, the leaf's is not."""
    likelihood, state = scene(4, n=1500)
    random = np.random.default_rng(0)
    on_leaf = likelihood.evaluate(state).responsibilities[:, 0] < 0.5
    rough = likelihood.points.copy()
    rough[on_leaf] += 0.4 * smooth_noise(rough[on_leaf], 1.0, 1.0, random)
    moved = likelihood.at(rough)
    found = score_dependence(moved, state)
    assert found.stem.correlation < 0.1
    assert found.leaf.reach_cm == pytest.approx(np.sqrt(2.0), rel=REACH)
    scores = moved.evaluate(state).scores
    varied = np.diag(found.variability) / np.diag(scores.T @ scores)
    assert varied[0] == pytest.approx(1.0, abs=0.2)  # of the stem's diameter
    assert varied[3] > 2.0  # of the leaf's length


# correlation over distance


def sheet(seed, reach_cm, height, n=800, n_waves=1000):
    """Places on a strip of 60 x 7 cm, and errors with a bell of that height and reach, on white noise.

    The bell's part is a sum of many waves, whose wave numbers are normal as the bell's Fourier transform is.
    """
    random = np.random.default_rng(seed)
    places = random.uniform(0.0, 1.0, (n, 3)) * [60.0, 7.0, 0.0]
    wave = random.normal(0.0, 1.0 / reach_cm, (3, n_waves))
    smooth = np.cos(places @ wave + random.uniform(0.0, 2.0 * np.pi, n_waves)).sum(axis=1) * np.sqrt(2.0 / n_waves)
    return places, np.sqrt(height) * smooth + np.sqrt(1.0 - height) * random.normal(size=n)


@pytest.mark.parametrize("height", [0.5, 1.0])
@pytest.mark.parametrize("reach_cm", [0.7, 1.4])
def test_a_bell_over_distance_is_found(reach_cm, height):
    """On average: one sheet has room for a few dozen bells."""
    found_height, found_reach = np.mean([_correlation(*sheet(seed, reach_cm, height)) for seed in range(8)], axis=0)
    assert found_reach == pytest.approx(reach_cm, rel=REACH)
    assert found_height == pytest.approx(height, abs=HEIGHT)
    assert 0.0 < found_height <= 1.0


def test_it_does_not_depend_on_the_errors_size_or_sign():
    places, errors = sheet(4, 1.4, 0.5, n=400)
    once, other = _correlation(places, errors), _correlation(places, -100.0 * errors)
    np.testing.assert_allclose(other, once, rtol=1e-6)


@pytest.mark.parametrize("n", [300, 1500])
def test_white_noise_is_not_correlated(n):
    """In one of many sheets it may look as if it were."""
    found = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        places = random.uniform(0.0, 1.0, (n, 3)) * [60.0, 7.0, 0.0]
        found.append(_correlation(places, random.normal(size=n)) != (0.0, 0.0))
    assert sum(found) <= 1


def test_neighbours_that_are_unlike_each_other_are_not_called_correlated():
    places, errors = sheet(6, 1.4, 0.5, n=400)
    order = np.argsort(places[:, 0])
    sign = np.empty(400)
    sign[order] = np.tile([1.0, -1.0], 200)
    assert _correlation(places, np.abs(errors) * sign) == (0.0, 0.0)


@pytest.mark.parametrize("n", [0, 1])
def test_no_neighbours(n):
    assert _correlation(np.zeros((n, 3)), np.ones(n)) == (0.0, 0.0)


def absorbed(seed, reach_cm, n=900):
    """Errors of reach `reach_cm` on a sheet, what a fit of nine smooth functions leaves of them, and the scores'
    changes and information of that fit; errors in the two other directions do not move it."""
    random = np.random.default_rng(seed)
    places = np.column_stack([random.uniform(0.0, 12.0, (n, 2)), np.zeros(n)])
    gap = np.linalg.norm(places[:, np.newaxis] - places, axis=2)
    errors = np.linalg.cholesky(np.exp(-0.5 * (gap / reach_cm) ** 2) + 1e-6 * np.eye(n)) @ random.standard_normal(n)
    u, v = places[:, :2].T / 6.0 - 1.0
    smooth = np.stack([u**i * v**j for i in range(3) for j in range(3)], axis=1)
    left = errors - smooth @ np.linalg.lstsq(smooth, errors)[0]
    return places, left, [np.zeros_like(smooth), np.zeros_like(smooth), smooth], smooth.T @ smooth


@pytest.mark.parametrize("reach_cm", [0.8, 1.5])
def test_the_part_of_the_errors_that_a_fit_took_up_is_told(reach_cm):
    scenes = [absorbed(seed, reach_cm) for seed in range(8)]
    as_left = np.mean([_correlation(places, left).reach_cm for places, left, _, _ in scenes])
    found = np.median([_before_the_fit(*scene, as_left) for scene in scenes], axis=0)
    assert as_left < 0.9 * reach_cm  # what is left reaches less far
    assert found == pytest.approx([1.0, reach_cm], rel=0.2)


def test_width_misfit_is_beyond_what_shared_noise_does():
    """Of the same clouds, less is misfit if neighbours share their noise."""
    found = []
    for seed in range(4):
        likelihood, state = scene(seed, n=1500, width_cm=1.0, share=1.0, noise_cm=1.0)
        at = likelihood.evaluate(state)
        found.append([width_misfit(likelihood, state, at, bell) for bell in (NONE, GaussianCorrelation(1.0, 1.4))])
    alone, shared = np.mean(found, axis=0)
    assert shared < 0.5 * alone
