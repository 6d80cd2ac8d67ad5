"""The benchmarks run; their yardstick is plain ICP."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

import phytofit
import phytofit.start.pose
from phytofit.models import move

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SAME = 1e-9  # cm; the same sums in the same order
AT_REST = 1e-6  # cm; the source is a part of the reference


def run(script, *arguments):
    done = subprocess.run(
        [sys.executable, BENCHMARKS / script, *arguments], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def brute_hausdorff(points, reference):
    distance = np.linalg.norm(points[:, np.newaxis] - reference, axis=2)
    return max(distance.min(axis=0).max(), distance.min(axis=1).max())


def load(name):
    if str(BENCHMARKS) not in sys.path:
        sys.path.insert(0, str(BENCHMARKS))
    return importlib.import_module(name)


def load_peers():
    return load("peers")


@pytest.fixture
def clouds():
    """A patch 8 by 3 cm as the reference, and other points of it, turned and shifted a little."""
    random = np.random.default_rng(0)
    u, v = random.uniform(-1, 1, (2, 700))
    patch = np.stack([4 * u, 1.5 * v, u**2 + 0.3 * u * v], axis=1)
    c, s = np.cos(0.15), np.sin(0.15)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return patch[:400] @ turn.T + [0.3, -0.2, 0.4], patch[400:]


@pytest.mark.long
def test_speed_benchmark_runs():
    said = run("speed.py", "--quick")
    for title in ("Table I:", "Equal work:", "A whole search:", "Floor:", "Agreement:"):
        assert title in said


def test_speed_benchmark_runs_one_part():
    said = run("speed.py", "table1", "--quick")
    assert "Table I:" in said
    assert "Agreement:" not in said


@pytest.mark.long
def test_accuracy_benchmark_runs():
    said = run("accuracy.py", "protocol", "--seeds", "1", "--phytomers", "2", "--samples", "30")
    assert said.count("leaf_length") == 2 * 3 * 3  # parameter and trait; the stem above as drawn, and as fitted


@pytest.mark.long
def test_trust_benchmark_runs():
    said = run("trust.py", "protocol", "correlated", "--phytomers", "3")
    assert said.count("3 phytomers") == 2
    assert "covered" in said


@pytest.mark.parametrize("rounds", [1, 5, 60])
def test_yardstick_is_plain_icp(clouds, rounds):
    peers = load_peers()
    points, reference = clouds
    plain = peers.scipy_peer(reference)
    pose, _ = plain.align(points, np.eye(4), rounds)
    end = peers.icp_to_rest(points, reference, cKDTree(reference), np.eye(4), max_iterations=rounds, tolerance_cm=0.0)
    np.testing.assert_allclose(end.pose, pose, atol=SAME)
    assert end.error == pytest.approx(plain.distance(points, pose), abs=SAME)


def test_yardstick_takes_the_least_of_its_starts(clouds):
    peers = load_peers()
    points, reference = clouds
    job = (points, np.zeros(3), reference, [np.eye(4)], 4, 0)
    error, least = peers.yardstick(job)
    start = peers.icp_to_rest(points, reference, cKDTree(reference), np.eye(4))
    assert least <= min(error, start.error)


def test_peers_align_alike(clouds):
    peers = load_peers()
    points, reference = clouds
    source, shift = reference[::3], np.array([0.05, -0.04, 0.06])  # at rest each point lies on its match
    start = peers.as_pose(np.eye(3), shift)
    for make in (peers.small_gicp_peer, peers.scipy_peer):
        peer = make(reference)
        pose, rounds = peer.align(source, start, 50)
        np.testing.assert_allclose(pose, np.eye(4), atol=AT_REST)
        assert 1 <= rounds <= 50
        assert peer.distance(points, np.eye(4)) == pytest.approx(brute_hausdorff(points, reference), abs=SAME)
        assert make(reference).align(source, start, 1)[1] == 1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_baseline_without_a_model_measures_a_clean_cloud(seed):
    made = phytofit.simulate(noise_cm=0.1, seed=seed)
    found = load("model_free").measure(made.points)
    true = {t.name: t.value for t in phytofit.measure(made.organs)}
    assert found["leaf_length"] == pytest.approx(true["leaf_length"], abs=3.0)
    assert found["stem_diameter"] == pytest.approx(true["stem_diameter"], abs=0.2)
    assert found["leaf_width"] == pytest.approx(true["leaf_width"], rel=0.15)
    assert found["leaf_angle"] == pytest.approx(true["leaf_angle"], abs=12.0)


def test_a_circle_is_measured_past_a_stub():
    random = np.random.default_rng(0)
    turn = random.uniform(0.0, 2.0 * np.pi, 60)
    ring = np.stack([0.4 + 1.6 * np.cos(turn), -0.3 + 1.6 * np.sin(turn)], axis=1)
    center, diameter = load("tape_measure").circle(ring)
    np.testing.assert_allclose(center, [0.4, -0.3], atol=1e-6)
    assert diameter == pytest.approx(3.2, abs=1e-6)
    stub = np.array([1.5, -0.3]) + random.uniform(0.8, 1.6, (10, 2)) * [1.0, 0.2]
    noisy = np.concatenate([ring + random.normal(0.0, 0.05, ring.shape), stub])
    assert load("tape_measure").circle(noisy)[1] == pytest.approx(3.2, abs=0.1)


@pytest.mark.parametrize("gap", [False, True])
def test_a_tape_follows_an_arc_from_the_stem(gap):
    """A blade 4 cm wide and 40 cm long, bent to a circle of 20 cm, on a stem of 3 cm; 4 cm of it may be missing."""
    tool, random = load("tape_measure"), np.random.default_rng(1)
    s, v = random.uniform(0.0, 40.0, 1500), random.uniform(-2.0, 2.0, 1500)
    if gap:
        s, v = s[(s < 20.0) | (s > 24.0)], v[(s < 20.0) | (s > 24.0)]
    bent = s / 20.0 + np.deg2rad(40.0)
    foot = np.array([1.5 + 20.0 * np.cos(np.deg2rad(40.0)), 0.0, -20.0 * np.sin(np.deg2rad(40.0))])
    blade = foot + np.stack([-20.0 * np.cos(bent), v, 20.0 * np.sin(bent)], axis=1)
    leaf = tool.leaf_of(blade + random.normal(0.0, 0.1, blade.shape), 1.5)
    tape = tool.tape_along(leaf, 1.5)
    assert tool.length_of(tape) == pytest.approx(40.0, abs=0.5)
    chord = np.rad2deg(np.deg2rad(40.0) + 8.0 / 40.0)  # over 8 cm, an arc's chord makes half its turn with the tangent
    assert tool.angle_over(tape, np.array([0.0, 0.0, 1.0]), 8.0) == pytest.approx(chord, abs=2.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_tape_measures_simulated_leaves(seed):
    """Their tips are pointed, so the last point lies some tenths of a centimetre before the tip."""
    tool, made = load("tape_measure"), phytofit.simulate(noise_cm=0.2, seed=seed)
    true = {trait.name: trait.value for trait in phytofit.measure(made.organs)}
    upright = np.linalg.inv(made.pose)
    radius = 0.5 * true["stem_diameter"]
    leaf = tool.leaf_of(made.points @ upright[:3, :3].T + upright[:3, 3], radius)
    tape = tool.tape_along(leaf, radius)
    assert -1.2 < tool.length_of(tape) - true["leaf_length"] < 0.5
    assert tool.angle_over(tape, np.array([0.0, 0.0, 1.0]), 8.0) == pytest.approx(true["leaf_angle"], abs=1.0)
    assert tool.expected_beyond(leaf, move(made.organs, upright)[1]) < 5.0


def test_the_extent_of_a_section_is_that_across_it():
    tool, random = load("tape_measure"), np.random.default_rng(2)
    across, off = random.uniform(-3.0, 3.0, 20_000), random.uniform(-0.5, 0.5, 20_000)
    turned = np.stack([2.0 + 0.8 * across - 0.6 * off, 1.0 + 0.6 * across + 0.8 * off], axis=1)
    assert tool.extent(turned) == pytest.approx(0.98 * 6.0, abs=0.05)


@pytest.mark.skipif(not (BENCHMARKS / "../../shared/data/openalea_synthetic_maize").is_dir(), reason="no data")
def test_maize_leaves_lie_along_their_true_organs():
    """Noise of 0.3 cm: every point of a leaf within 2 cm of the midrib's half width, or of the stem's surface."""
    leaves = load("trust").maize_leaves(n_points=600)
    assert len(leaves) > 15
    for leaf in leaves:
        stem, blade = leaf.organs
        assert len(leaf.points) == 600
        near = np.linalg.norm(leaf.points[:, np.newaxis] - blade.axis, axis=2).min(axis=1)
        rho = np.hypot(leaf.points[:, 0], leaf.points[:, 1])
        assert np.all((near < blade.half_width.max() + 2.0) | (rho < stem.half_width.max() + 1.5)), leaf.name
        assert 10.0 < blade.segment_lengths.sum() < 130.0


def test_a_leaf_is_cut_with_its_piece_of_stem_and_scaled():
    """A plant in mm whose stem goes on for 30 cm, and a second leaf: the piece has its place, its axis and its size."""
    cut_leaves = load("cut_leaves")
    lengths = {"stem_length": 30.0, "stem_length_above": 30.0, "leaf_length": 40.0}
    made = phytofit.simulate(fixed=lengths, noise_cm=0.1, seed=1)
    other = made.labels == 2
    beside = made.points[other] @ np.diag([1.0, 1.0, 1.0]) + 60.0 * made.pose[:3, 2]
    points = 10.0 * np.concatenate([made.points, beside])
    plant = cut_leaves.Plant("", "", "", points, np.concatenate([made.labels, np.full(other.sum(), 3)]))
    leaf = cut_leaves.cut_leaf(plant, 2, 100_000)
    start = leaf.starts[0]
    assert np.sum(leaf.organ == 1) == other.sum()
    assert start.pose[:3, 2] @ made.pose[:3, 2] > np.cos(np.deg2rad(3.0))
    assert start.pose[:3, 0] @ made.pose[:3, 0] > np.cos(np.deg2rad(10.0))
    scale = cut_leaves.LEAF_CM / 40.0
    assert start.radius == pytest.approx(0.5 * scale * made.x[0], rel=0.1)
    assert start.top - start.foot == pytest.approx(25.0, abs=1.0)
    nearest = cKDTree(leaf.points[leaf.organ == 1]).query(leaf.points[leaf.organ == 0])[0]
    assert nearest.min() < 1.0
    assert cut_leaves.midrib_length(leaf.points[leaf.organ == 1], 0) > 0.0
    assert cut_leaves.cut_leaf(plant, 4, 1000) is None


@pytest.mark.long
def test_evidence_tells_a_parameter_that_is_there_from_one_that_is_not(monkeypatch):
    """Leaves that bend sideways, each by another angle, and have no wave: the one pays for itself on plants that were
    left out, the other costs."""
    evidence = load("evidence")
    there, absent = "leaf_side_bend", "leaf_wave"
    monkeypatch.setattr(evidence, "HELD", {"full": (), there: (there,), absent: (absent,)})
    for name, grid in (("ANGLE", (45.0,)), ("BEND", (3.5,)), ("ROLL", (0.0,))):
        monkeypatch.setattr(evidence, f"BEGUN_{name}", grid)
    cut = []
    for seed, bend in enumerate((-25.0, -10.0, 12.0, 24.0)):
        made = phytofit.simulate(fixed={there: bend}, n_points=500, seed=seed)
        start = phytofit.start.pose.StartPose(made.pose @ moved_up(made.x[1]), -made.x[1], made.x[6], 1.5, 0.0, 0.0)
        cut.append(evidence.Leaf("simulated", str(seed), "", made.points, (made.labels - 1).astype(np.int8), [start]))
    fits, found = evidence.study(cut, map)
    assert len(fits) == len(cut)
    assert min(it[there][0] for it in found) > 2.0
    assert np.mean([it[absent][0] for it in found]) < 0.0


def moved_up(height):
    pose = np.eye(4)
    pose[2, 3] = height
    return pose


def test_copies_of_a_cloud_are_the_same_leaf():
    tool, points = load("repeatability"), np.random.default_rng(0).uniform(-20.0, 20.0, (400, 3))
    cloud = phytofit.from_points(points, "cm")
    permuted, subset, moved = (
        tool.copy_of(cloud, tool.Copy(kind, 3)).points for kind in ("permuted", "subset", "moved")
    )
    np.testing.assert_array_equal(permuted[np.lexsort(permuted.T)], points[np.lexsort(points.T)])
    assert not np.array_equal(permuted, points)
    assert len(subset) == 360
    assert {tuple(p) for p in subset} < {tuple(p) for p in points}
    assert 0.0 < np.abs(moved - points).max() < 1e-8


def test_a_trait_comes_back_if_its_spread_is_within_half_its_interval():
    tool = load("repeatability")

    def measured(length, flagged=False):
        return tool.Measured({"leaf_length": length}, {"leaf_length": (48.0, 52.0)}, {"leaf_length": flagged})

    def row(*lengths):
        copies = {tool.Copy("subset", i): measured(length) if length else None for i, length in enumerate(lengths)}
        return next(tool.rows_of("leaf", measured(50.0), copies))

    near, far, refused = row(51.0, 49.5), row(51.0, 47.5), row(51.0, None)
    assert (near.half, near.spread["subset"], near.beyond, near.comes_back) == (2.0, 1.0, 0, True)
    assert (far.spread["subset"], far.beyond, far.comes_back) == (2.5, 1, False)
    assert not refused.comes_back
    assert tool.half_interval(50.0, 47.0, None) == 3.0
    assert tool.half_interval(50.0, None, None) == np.inf


@pytest.mark.long
def test_robustness_benchmark_measures_each_step():
    robustness = load("robustness")
    for name, sweep in robustness.SWEEPS.items():
        outcome = robustness.measured(robustness.Job(name, sweep.steps[0], 0, True))
        assert outcome.found, name
        assert np.all(np.isfinite(outcome.peers)), name


def test_a_foreign_leaf_has_the_truth_of_its_surface():
    foreign_leaves = load("foreign_leaves")
    surface, truth = foreign_leaves.phytomer(np.random.default_rng(3))
    stem = surface.points[surface.organ == foreign_leaves.STEM]
    blade = surface.points[surface.organ == foreign_leaves.BLADE]
    middle = blade.reshape(foreign_leaves.N_ALONG - 1, foreign_leaves.N_ACROSS - 1, 3)[:, 39:41].mean(axis=1)
    along = np.linalg.norm(np.diff(middle, axis=0), axis=1).sum()
    assert truth["leaf_length"] == pytest.approx(along, rel=0.005)
    across = blade.reshape(foreign_leaves.N_ALONG - 1, -1, 3)
    widest = np.linalg.norm(np.diff(across, axis=1), axis=2).sum(1).max() * 80 / 79
    assert truth["leaf_width"] == pytest.approx(widest, rel=0.005)
    below = stem[stem[:, 2] < blade[:, 2].min()]
    hull = [
        np.ptp(below[np.abs(below[:, 2] - z) < 0.2, :2], axis=0).mean() for z in np.linspace(1, below[:, 2].max(), 9)
    ]
    assert truth["stem_diameter"] == pytest.approx(np.mean(hull), rel=0.06)  # its axes may lie askew


def test_a_foreign_cloud_lies_on_its_surface_and_comes_back():
    foreign, foreign_leaves = load("foreign"), load("foreign_leaves")
    surface, _ = foreign_leaves.phytomer(np.random.default_rng(5))
    still = foreign.Camera(90.0, 0.2, 0.0, 0.0, 2.0, 0.0, 0.1, 0.0, 0.0)
    seen = foreign.seen_by(still, 3, surface, np.random.default_rng(6))
    assert cKDTree(surface.points).query(seen)[0].max() < 0.1
    assert len(seen) > 1000
    again = [foreign.cloud(2, on_grid=True)[0] for _ in range(2)]
    np.testing.assert_array_equal(*again)


@pytest.mark.long
def test_foreign_benchmark_runs():
    said = run("foreign.py", "grid", "--leaves", "2")
    assert "leaf_insertion_angle" in said


def test_the_discrepancy_is_learned_of_errors_beyond_their_intervals():
    """Of leaves whose every trait is off by one parameter each: of known spreads, with noise of known size."""
    discrepancy = load("discrepancy")
    random = np.random.default_rng(3)
    true = np.array([0.04, 3.0, 0.02, 0.05, 8.0])
    leaves = []
    for _ in range(400):
        change = np.zeros((6, 5))
        change[[0, 1, 2, 3, 4, 5], [2, 1, 4, 3, 3, 0]] = [50.0, 1.0, 1.0, 6.0, 200.0, 3.0]
        off, std = true * random.standard_normal(5), np.abs(change).sum(axis=1) * 0.01
        leaves.append(discrepancy.Leaf(change @ off + std * random.standard_normal(6), std, change))
    np.testing.assert_allclose(discrepancy.learned(leaves), true, rtol=0.25)


JUDGED = """NUMBER = 4  # points
FIRST, SECOND = 0.5, (1, 2)  # both
WORD = "no number"
lower = 3
FOLLOWS: float = 2.0 * NUMBER
"""


def test_every_judged_number_is_found_and_changed_where_it_stands(monkeypatch, tmp_path):
    """Also one of several on a line; the changed copy runs with the new value, and only that one is new."""
    sensitivity = load("sensitivity")
    package = tmp_path / "phytofit"
    for folder in sensitivity.FOLDERS:
        (package / folder).mkdir(parents=True)
    for folder in (package, package / "engine"):
        (folder / "__init__.py").write_text("")
    (package / "engine" / "judged.py").write_text(JUDGED)
    monkeypatch.setattr(sensitivity, "SOURCES", package)
    found = {number.name: number for number in sensitivity.numbers()}
    assert {name: number.why for name, number in found.items()} == {
        "NUMBER": "points",
        "FIRST": "both",
        "SECOND": "both",
        "FOLLOWS": "",
    }
    show = ["-c", "from phytofit.engine.judged import *; print(NUMBER, FIRST, SECOND, FOLLOWS)"]
    for name, factor, shown in (
        ("NUMBER", 0.5, "2 0.5 (1, 2) 4.0"),
        ("FIRST", 2.0, "4 1.0 (1, 2) 8.0"),
        ("SECOND", 2.0, "4 0.5 (2, 4) 8.0"),
        ("FOLLOWS", 0.5, "4 0.5 (1, 2) 4.0"),
    ):
        assert sensitivity.in_copy(found[name], factor, show).stdout.strip() == shown


def test_what_is_not_judged_is_there():
    sensitivity = load("sensitivity")
    missing = []
    for key in sensitivity.NOT_JUDGED:
        module, name = key.split(".")
        files = list(sensitivity.SOURCES.rglob(f"{module}.py"))
        if not any(name in dict(sensitivity._assigned(ast.parse(file.read_text("utf-8")))) for file in files):
            missing.append(key)
    assert not missing
