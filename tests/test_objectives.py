"""The paper's objective: exact where it says so, pruned without changing the elite, blind to the number of threads."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial import cKDTree

from phytofit import CloudError, load_species
from phytofit.models import SurfaceSampler
from phytofit.paper import objective as objectives
from phytofit.paper.distances import DISTANCES, Reference, chamfer, labelled_hausdorff, quantile_hausdorff
from phytofit.paper.objective import PaperObjective

FLOAT32_CM = 2e-4  # clouds are float32 about 60 cm from the origin in the kernels
N_POINTS = 600


@pytest.fixture(scope="module")
def scene():
    """A noisy phytomer upright with its junction at the origin, and a mid-search population around its parameters."""
    species = load_species()
    truth = np.array([3.0, 15.0, 50.0, 55.0, 6.0, 3.5, 10.0])
    organs = [o.row(0) for o in species.model.organs(truth)]
    points, organ = SurfaceSampler(N_POINTS, 5).draw(organs)
    random = np.random.default_rng(1)
    points = points + random.normal(0.0, 0.3, points.shape) - organs[1].axis[0]
    xs = truth + 0.3 * species.space.std[:7] * random.standard_normal((60, 7))
    return species, points, organ, np.maximum(xs, 0.5)


def reference_hausdorff(a, b):
    return max(cKDTree(b).query(a)[0].max(), cKDTree(a).query(b)[0].max())


def moved_candidate(species, x, pose, seed=0):
    organs = [o.row(0) for o in species.model.organs(x)]
    points, organ = SurfaceSampler(N_POINTS, seed).draw(organs)
    return points @ pose[:3, :3].T + pose[:3, 3], organ


def test_error_is_the_exact_hausdorff_distance_at_the_registered_pose(scene):
    species, points, _, xs = scene
    objective = PaperObjective(species.model, Reference.of(points), n_points=N_POINTS)
    errors = objective(xs[:4])
    for x, error in zip(xs[:4], errors, strict=True):
        registration, again = objective.register(x)
        placed, _ = moved_candidate(species, x, registration.T_target_source)
        assert again == error
        assert error == pytest.approx(reference_hausdorff(placed, points), abs=FLOAT32_CM)
        rotation = registration.T_target_source[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_the_true_parameters_are_registered_where_they_are(scene):
    species, points, _, _ = scene
    truth = np.array([3.0, 15.0, 50.0, 55.0, 6.0, 3.5, 10.0])
    registration, error = PaperObjective(species.model, Reference.of(points), n_points=N_POINTS).register(truth)
    expected = np.eye(4)
    expected[2, 3] = -15.0  # the junction is at the origin
    np.testing.assert_allclose(registration.T_target_source, expected, atol=0.6)
    assert error < 2.5
    assert registration.rmse < 1.0


def test_giving_up_early_changes_no_elite(scene, monkeypatch):
    species, points, _, xs = scene
    objective = PaperObjective(species.model, Reference.of(points), n_points=N_POINTS)
    pruned = objective(xs, 6)
    monkeypatch.setattr(objectives._Level, "limit", property(lambda self: np.inf))
    np.testing.assert_array_equal(pruned, objective(xs, 6))
    assert np.isfinite(pruned).sum() == 6


def test_elite_is_the_best_of_the_shortlist(scene):
    species, points, _, xs = scene
    objective = PaperObjective(species.model, Reference.of(points), n_points=N_POINTS)
    everyone, elite = objective(xs), objective(xs, 6)
    chosen = np.isfinite(elite)
    np.testing.assert_array_equal(elite[chosen], everyone[chosen])
    assert len(set(np.argsort(everyone)[:6]) & set(np.flatnonzero(chosen))) >= 4  # few good ones look bad at first


def test_threads_change_nothing(scene):
    species, points, _, xs = scene
    alone = PaperObjective(species.model, Reference.of(points), n_points=N_POINTS)(xs, 6)
    with ThreadPoolExecutor(4) as executor:
        together = PaperObjective(species.model, Reference.of(points), n_points=N_POINTS, executor=executor)(xs, 6)
    np.testing.assert_array_equal(alone, together)


def test_equal_candidates_have_equal_errors_and_asking_for_all_is_allowed(scene):
    species, points, _, xs = scene
    objective = PaperObjective(species.model, Reference.of(points), n_points=N_POINTS)
    twice = np.concatenate([xs[:3], xs[:3]])
    errors = objective(twice, 6)
    np.testing.assert_array_equal(errors[:3], errors[3:])
    assert np.isfinite(objective(xs[:3], 50)).all()


def test_an_upside_down_start_is_found(scene):
    species, points, _, xs = scene
    flip = np.diag([1.0, -1.0, -1.0])
    objective = PaperObjective(
        species.model,
        Reference.of(points @ flip),
        starts=[np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])],
        n_points=N_POINTS,
    )
    right_way_up = PaperObjective(species.model, Reference.of(points), n_points=N_POINTS)
    assert np.median(objective(xs[:6])) == pytest.approx(np.median(right_way_up(xs[:6])), abs=0.3)


@pytest.mark.parametrize("name", sorted(set(DISTANCES) - {"labels"}))
def test_distances_against_scipy(scene, name):
    species, points, _, xs = scene
    reference = Reference.of(points)
    expected = {
        "hausdorff": lambda f, b: max(f.max(), b.max()),
        "quantile": lambda f, b: max(np.quantile(f, 0.95), np.quantile(b, 0.95)),
        "chamfer": lambda f, b: 0.5 * (f.mean() + b.mean()),
    }[name]
    for x in xs[:5]:
        placed, organ = moved_candidate(species, x, np.eye(4))
        forward, backward = cKDTree(points).query(placed)[0], cKDTree(placed).query(points)[0]
        columns = np.ascontiguousarray(placed.T, np.float32)
        assert DISTANCES[name](reference)(columns, organ, np.inf) == pytest.approx(
            expected(forward, backward), abs=FLOAT32_CM
        )


def test_quantile_one_is_hausdorff_and_a_stray_point_does_not_decide_the_quantile(scene):
    species, points, _, xs = scene
    placed, organ = moved_candidate(species, xs[0], np.eye(4))
    columns = np.ascontiguousarray(placed.T, np.float32)
    plain = DISTANCES["hausdorff"](Reference.of(points))(columns, organ, np.inf)
    assert quantile_hausdorff(Reference.of(points), 1.0)(columns, organ, np.inf) == pytest.approx(plain, abs=1e-5)
    stray = Reference.of(np.concatenate([points, [[300.0, 0.0, 0.0]]]))
    assert DISTANCES["hausdorff"](stray)(columns, organ, np.inf) > 200.0
    assert quantile_hausdorff(stray)(columns, organ, np.inf) == pytest.approx(
        quantile_hausdorff(Reference.of(points))(columns, organ, np.inf), rel=0.05
    )
    unmoved = chamfer(Reference.of(points))(columns, organ, np.inf)
    assert chamfer(stray)(columns, organ, np.inf) - unmoved < 0.5 * 300.0 / N_POINTS


def brute_labelled(a, label_a, b, label_b, cost):
    d = np.linalg.norm(a[:, None] - b[None], axis=2)
    unknown = label_b < 0
    d = d + cost * ((label_a[:, None] != label_b[None]) & ~unknown[None])
    return max(d.min(axis=1).max(), d.min(axis=0).max())


@pytest.mark.parametrize(("cost", "unknown_share"), [(0.0, 0.0), (2.0, 0.0), (2.0, 0.3), (50.0, 0.3)])
def test_labelled_hausdorff_against_brute_force(scene, unknown_share, cost):
    species, points, organ, xs = scene
    labels = organ.copy()
    labels[np.random.default_rng(0).random(len(labels)) < unknown_share] = -1
    placed, placed_organ = moved_candidate(species, xs[1], np.eye(4))
    columns = np.ascontiguousarray(placed.T, np.float32)
    got = labelled_hausdorff(Reference.of(points, labels), cost)(columns, placed_organ, np.inf)
    expected = brute_labelled(placed, placed_organ, points, labels, cost)
    assert got == pytest.approx(expected, abs=FLOAT32_CM)


def test_labelled_hausdorff_with_one_organ_missing(scene):
    species, points, organ, xs = scene
    placed, placed_organ = moved_candidate(species, xs[2], np.eye(4))
    columns = np.ascontiguousarray(placed.T, np.float32)
    leaf_only = organ == 1
    got = labelled_hausdorff(Reference.of(points[leaf_only], organ[leaf_only]), 7.0)(columns, placed_organ, np.inf)
    expected = brute_labelled(placed, placed_organ, points[leaf_only], organ[leaf_only], 7.0)
    assert got == pytest.approx(expected, abs=FLOAT32_CM)


def test_labels_are_needed_for_the_labelled_distance(scene):
    _, points, _, _ = scene
    with pytest.raises(CloudError, match="the cloud has no labels"):
        labelled_hausdorff(Reference.of(points))
