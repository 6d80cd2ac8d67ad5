"""ICP against small_gicp and against a brute-force Besl-McKay loop with a k-d tree and an SVD."""

from typing import NamedTuple

import numpy as np
import pytest
import small_gicp
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from phytofit.kernels.icp import BLOCK, MAX_MEMORY, best_rotation, icp, transform
from phytofit.kernels.nearest import nearest_grid

PROPER = 1e-9  # how far R R^T may be from 1, and det R: float64
TOLERANCE = 1e-5  # cm; a round that moves the pose by less ends the loop
SAME_POSE = 1e-3  # cm, RMS over the source; float32 matches on coordinates of up to 30 cm, and the loop's tolerance
CANCELLATION = 3e-6  # of the largest coordinate squared: the mean square is a difference of such sums in float32
CELL = 0.06  # cm, of the grids below unless stated
APART = 2 * CELL  # cm; points as far apart have a cell to themselves
LOOK_UP = 3 * CELL**2  # cm²; a match may be a cell's diagonal further away than the nearest
WORSE_BY_MIXING = 0.05  # share; a mixed path may come to rest at another of the many fixed points on a noisy surface


class Problem(NamedTuple):
    source: np.ndarray  # (n, 3), mean zero, exact in float32
    target: np.ndarray  # (m, 3)
    r: np.ndarray
    t: np.ndarray


def centered(points):
    points = points - points.mean(axis=0)
    return points.astype(np.float32).astype(float)


def random_rotation(random, degrees):
    axis = random.normal(size=3)
    return Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)).as_matrix()


def surface(random, n):
    """Points on a curved, chiral patch 8 by 3 cm."""
    u, v = random.uniform(-1, 1, (2, n))
    return np.stack([4 * u + 10.0, 1.5 * v - 20.0, u**2 + 0.3 * u * v + 0.2 * u**3 + 5.0], axis=1)


def copies(seed, degrees, shift=0.3, n=240):
    """The source is a part of the target: the true pose has no error.

    Each point has its cell of the grid to itself, so that the true pose is at rest.
    """
    random = np.random.default_rng(seed)
    target = surface(random, n)
    crowded = cKDTree(target).query_pairs(APART, output_type="ndarray")[:, 1]
    target = np.delete(target, crowded, axis=0)
    part = target[random.permutation(len(target))[: 2 * len(target) // 3]]
    return Problem(
        centered(part), target, random_rotation(random, degrees), part.mean(axis=0) + random.normal(0, shift, 3)
    )


def noisy(seed, degrees, shift=0.3, n=240, noise=0.05):
    """Source and target are different points of one surface."""
    random = np.random.default_rng(seed)
    target = surface(random, n) + random.normal(0, noise, (n, 3))
    source = surface(random, n)
    return Problem(
        centered(source), target, random_rotation(random, degrees), source.mean(axis=0) + random.normal(0, shift, 3)
    )


def look_up(problem, cell=CELL):
    """The target's grid, and its cells' diagonal: how much further than the nearest a match may be."""
    grid = nearest_grid(problem.target, cell=cell)
    return grid, np.sqrt(3.0) / grid.inverse_cell


def register(problem, grid, memory=0, max_iterations=200):
    source = np.ascontiguousarray(problem.source.T, np.float32)
    return icp(source, grid, problem.r, problem.t, max_iterations, TOLERANCE, memory)


def solve(problem, *, memory=0, max_iterations=200, cell=CELL):
    """The kernel's answer, and how much further than the nearest a match may be."""
    grid, diagonal = look_up(problem, cell)
    return register(problem, grid, memory, max_iterations), diagonal


def kabsch(p, q):
    p_mean, q_mean = p.mean(axis=0), q.mean(axis=0)
    u, _, vt = np.linalg.svd((p - p_mean).T @ (q - q_mean))
    r = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return r, q_mean - r @ p_mean


def besl_mckay(problem, max_iterations=200):
    source, target, r, t = problem
    tree = cKDTree(target)
    for _ in range(max_iterations):
        _, match = tree.query(source @ r.T + t)
        r_next, t_next = kabsch(source, target[match])
        moved = rms(source @ (r_next - r).T + (t_next - t))
        r, t = r_next, t_next
        if moved < TOLERANCE:
            break
    return r, t


def peer(problem):
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = problem.r, problem.t
    target = small_gicp.PointCloud(problem.target)
    result = small_gicp.align(
        target,
        small_gicp.PointCloud(problem.source),
        small_gicp.KdTree(target),
        init_T_target_source=start,
        registration_type="ICP",
        max_correspondence_distance=1e3,
        num_threads=1,
        max_iterations=200,
        rotation_epsilon=1e-7,
        translation_epsilon=1e-7,
    )
    return result.T_target_source[:3, :3], result.T_target_source[:3, 3]


def rms(vectors):
    return np.sqrt(np.mean(np.sum(vectors**2, axis=1)))


def error(problem, r, t):
    """True RMS distance of the placed source to the target."""
    return np.sqrt(np.mean(cKDTree(problem.target).query(problem.source @ r.T + t)[0] ** 2))


def apart(problem, pose, other):
    """RMS distance between the source in one pose and in another."""
    return rms(problem.source @ (pose[0] - other[0]).T + (pose[1] - other[1]))


def assert_proper(r):
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=PROPER)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, atol=PROPER)


SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize("memory", [0, 5])
@given(seed=SEEDS, degrees=st.floats(0, 6))
@settings(max_examples=10)
def test_a_copy_is_laid_where_both_oracles_lay_it(memory, seed, degrees):
    problem = copies(seed, degrees, shift=0.1)
    expected = besl_mckay(problem)
    assume(error(problem, *expected) < SAME_POSE)  # else it stopped short of the true pose
    (r, t, mse, _, converged), _ = solve(problem, memory=memory)
    assert converged
    assert_proper(r)
    assert apart(problem, (r, t), expected) < SAME_POSE
    assert apart(problem, (r, t), peer(problem)) < SAME_POSE
    assert mse < CANCELLATION * np.abs(problem.target).max() ** 2


@given(seed=SEEDS, n=st.integers(3, 60))
@settings(max_examples=8)
def test_plain_icp_is_besl_mckay_where_no_match_is_in_doubt(seed, n):
    """Points a centimetre apart, all placed within 0.35 cm of their partner: every look-up has one possible answer."""
    random = np.random.default_rng(seed)
    lattice = np.stack(np.meshgrid(*[np.arange(4.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    target = lattice + random.uniform(-0.05, 0.05, lattice.shape) + [7.0, -12.0, 3.0]
    part = target[random.permutation(64)[:n]]
    source = part + random.uniform(-0.05, 0.05, part.shape)
    problem = Problem(
        centered(source),
        target,
        random_rotation(random, random.uniform(0, 3)),
        source.mean(axis=0) + random.uniform(-0.05, 0.05, 3),
    )
    for rounds in (1, 2, 200):
        (r, t, _, _, _), _ = solve(problem, max_iterations=rounds, cell=0.1)
        assert apart(problem, (r, t), besl_mckay(problem, rounds)) < SAME_POSE


@given(seed=SEEDS, degrees=st.floats(0, 180))
@settings(max_examples=10)
def test_where_plain_icp_rests_besl_mckay_rests(seed, degrees):
    """From any start: going on with exact matches gains no more than the look-ups' error, a cell's diagonal."""
    problem = noisy(seed, degrees, shift=1.0)
    (r, t, mse, _, _), diagonal = solve(problem)
    assert_proper(r)
    reached = error(problem, r, t)
    assert reached <= np.sqrt(mse) + SAME_POSE
    assert np.sqrt(mse) <= reached + diagonal
    r_next, t_next = besl_mckay(problem._replace(r=r, t=t), 1)
    assert error(problem, r_next, t_next) >= reached - diagonal


@given(seed=SEEDS, degrees=st.floats(0, 20))
@settings(max_examples=8)
def test_noisy_surfaces_end_as_near_as_the_oracles(seed, degrees):
    problem = noisy(seed, degrees)
    (r, t, _, _, _), diagonal = solve(problem)
    reached = error(problem, r, t)
    assert reached < error(problem, *besl_mckay(problem)) + diagonal
    assert reached < error(problem, *peer(problem)) + diagonal


@pytest.mark.parametrize("memory", [0, 1, 5, MAX_MEMORY])
def test_never_worse_however_early_it_ends(memory):
    """The pose that comes out has been matched, or is a plain step from one that has; and every round gains."""
    for seed in range(10):
        problem = noisy(seed, 30.0 + 16 * seed, shift=1.0, n=60)
        grid, _ = look_up(problem)
        cancellation = CANCELLATION * np.abs(problem.target).max() ** 2
        last_mse = np.inf
        for max_iterations in (1, 2, 3, 5, 8, 10):
            r, t, mse, iterations, _ = register(problem, grid, memory, max_iterations)
            assert iterations <= max_iterations
            assert error(problem, r, t) <= np.sqrt(mse + cancellation)
            assert mse <= last_mse + LOOK_UP + cancellation
            last_mse = mse
        assert error(problem, r, t) <= error(problem, problem.r, problem.t)


def test_mixing_is_as_good_as_plain_icp():
    ratios = []
    for seed in range(10):
        problem = noisy(seed, 10.0)
        grid, _ = look_up(problem)
        plain, mixed = (error(problem, *register(problem, grid, memory)[:2]) for memory in (0, 5))
        ratios.append(mixed / plain)
    assert np.median(ratios) <= 1.0 + WORSE_BY_MIXING
    assert np.max(ratios) <= 1.0 + 3 * WORSE_BY_MIXING


def test_no_more_than_the_largest_memory_is_mixed():
    for seed in range(2):
        problem = noisy(seed, 20.0, n=800, noise=0.0)
        grid, _ = look_up(problem)
        most, more = (register(problem, grid, memory, 60) for memory in (MAX_MEMORY, 10 * MAX_MEMORY))
        np.testing.assert_array_equal(more[0], most[0])
        np.testing.assert_array_equal(more[1], most[1])


def test_mixing_is_nearer_after_few_rounds():
    """Where the source slides along a smooth surface plain ICP creeps."""
    ratios = []
    for seed in range(6):
        problem = noisy(seed, 20.0, n=800, noise=0.0)
        grid, _ = look_up(problem)
        plain, mixed = (error(problem, *register(problem, grid, memory, 10)[:2]) for memory in (0, 5))
        ratios.append(mixed / plain)
    assert np.median(ratios) < 1.0 - WORSE_BY_MIXING
    assert np.max(ratios) < 1.0 + WORSE_BY_MIXING


COORDINATE = st.one_of(st.floats(-10, 10, width=32), st.integers(-2, 2).map(float))


def clouds():
    free = st.integers(1, 8).flatmap(lambda n: arrays(np.float64, (n, 3), elements=COORDINATE))
    planar = free.map(lambda p: p * [1.0, 1.0, 0.0])
    collinear = free.map(lambda p: p[:, :1] * [1.0, 2.0, -1.0])
    return st.one_of(free, planar, collinear)


ONE = np.array([[1.0, 2.0, 3.0]])
TWO = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
CUBE = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)


@given(clouds(), clouds(), SEEDS, st.sampled_from([0, 5]))
@example(ONE, ONE, 0, 0)
@example(ONE, TWO, 1, 5)
@example(TWO, ONE, 2, 5)
@example(TWO, 3 * TWO, 3, 5)
@example(CUBE, CUBE, 4, 5)
@example(np.repeat(ONE, 6, axis=0), CUBE, 5, 0)
@settings(max_examples=40)
def test_few_tied_planar_and_collinear_points(source, target, seed, memory):
    random = np.random.default_rng(seed)
    r_start = Rotation.random(rng=random).as_matrix()
    t_start = target.mean(axis=0) + random.normal(0, 1, 3)
    problem = Problem(centered(source), target, r_start, t_start)
    size = np.linalg.norm(np.ptp(target, axis=0)) + 1.0
    (r, t, mse, iterations, _), diagonal = solve(problem, memory=memory, max_iterations=50, cell=size / 25)
    assert_proper(r)
    assert np.all(np.isfinite(t))
    assert 1 <= iterations <= 50
    assert 0.0 <= mse < np.inf
    assert error(problem, r, t) <= error(problem, r_start, t_start) + diagonal


def test_one_point_goes_to_its_nearest():
    target = np.array([[5.0, 1.0, -2.0], [9.0, 1.0, -2.0]])
    (r, t, mse, _, converged), _ = solve(Problem(np.zeros((1, 3)), target, np.eye(3), np.array([8.0, 2.0, 0.0])))
    assert converged
    assert_proper(r)
    np.testing.assert_allclose(t, target[1], atol=SAME_POSE)
    np.testing.assert_allclose(mse, 0.0, atol=CANCELLATION * 81)


def test_a_collinear_cloud_may_turn_only_about_itself():
    along = np.linspace(-3, 3, 25)[:, np.newaxis]
    target = along * [1.0, 1.0, 0.0] + [4.0, 5.0, 6.0]
    source = centered(along * [1.0, 1.0, 0.0])
    problem = Problem(source, target, random_rotation(np.random.default_rng(0), 6.0), np.array([4.0, 5.1, 6.0]))
    (r, t, _, _, converged), _ = solve(problem)
    assert converged
    assert_proper(r)
    np.testing.assert_allclose(source @ r.T + t, target, atol=SAME_POSE)


@given(seed=SEEDS)
@settings(max_examples=6)
def test_a_mirrored_copy_is_never_reflected(seed):
    """The reflection would lay it exactly; the rotation is what is asked for."""
    problem = copies(seed, 5.0)
    problem = problem._replace(source=centered(problem.source * [1.0, -1.0, 1.0]))
    (r, _, mse, _, _), _ = solve(problem)
    assert_proper(r)
    assert mse > 1e-3


@pytest.mark.parametrize("memory", [0, 5])
def test_the_true_pose_stays(memory):
    problem = copies(0, 0.0, shift=0.0)
    (r, t, _, iterations, converged), _ = solve(problem, memory=memory)
    assert (iterations, converged) == (1, True)
    assert apart(problem, (r, t), (problem.r, problem.t)) < SAME_POSE


def test_clouds_of_several_blocks_and_far_from_the_origin():
    """Matches are summed in blocks; and 3 m from the origin is where a plant cloud may well lie."""
    problem = copies(1, 5.0, n=600)
    problem = problem._replace(source=np.tile(problem.source, (5, 1)))
    assert len(problem.source) > 2 * BLOCK
    far = np.array([300.0, -300.0, 300.0])
    (r, t, _, _, converged), _ = solve(problem)
    (r_far, t_far, _, _, _), _ = solve(problem._replace(target=problem.target + far, t=problem.t + far))
    assert converged
    assert error(problem, r, t) < SAME_POSE
    assert error(problem, r_far, t_far - far) < SAME_POSE


def test_the_start_is_left_as_it_was():
    problem = noisy(2, 10.0)
    r, t = problem.r.copy(), problem.t.copy()
    solve(problem, memory=5)
    np.testing.assert_array_equal(problem.r, r)
    np.testing.assert_array_equal(problem.t, t)


def test_transform_moves_columns():
    random = np.random.default_rng(3)
    source = random.normal(0, 10, (3, 50)).astype(np.float32)
    r, t = random_rotation(random, 130.0), np.array([5.0, -7.0, 9.0])
    out = np.empty_like(source)
    transform(source, r, t, out)
    np.testing.assert_allclose(out, r @ source + t[:, np.newaxis], rtol=1e-6, atol=1e-5)


def largest(cross):
    """Maximum over proper rotations of sum q . R p = tr(R cross), from singular values (Kabsch 1976)."""
    u, s, vt = np.linalg.svd(cross)
    return s[0] + s[1] + np.sign(np.linalg.det(u) * np.linalg.det(vt)) * s[2]


ENTRY = st.one_of(st.floats(-100, 100).map(lambda v: round(v, 6)), st.integers(-2, 2).map(float))


def crosses():
    full = arrays(np.float64, (3, 3), elements=ENTRY)
    vector = arrays(np.float64, (3,), elements=ENTRY)
    rank_1 = st.tuples(vector, vector).map(lambda v: np.outer(*v))
    rank_2 = st.tuples(rank_1, rank_1).map(sum)
    return st.one_of(full, rank_1, rank_2)


@given(crosses())
@example(np.zeros((3, 3)))
@example(-np.eye(3))
@example(np.diag([1.0, 1.0, -1.0]))
@example(np.diag([2.0, -1.0, -1.0]))
@example(np.diag([5.0, 0.0, 0.0]))
@example(np.diag([-5.0, 0.0, 0.0]))
@example(np.diag([1e8, 1.0, 1e-8]))
@settings(max_examples=80)
def test_best_rotation_is_proper_and_best(cross):
    r = best_rotation(np.ascontiguousarray(cross))
    assert_proper(r)
    scale = np.abs(cross).max()
    np.testing.assert_allclose(np.trace(r @ cross), largest(cross), rtol=0, atol=1e-9 * scale)


@given(SEEDS, st.integers(3, 20))
def test_best_rotation_is_that_of_scipy(seed, n):
    random = np.random.default_rng(seed)
    p, q = random.normal(0, 3, (2, n, 3))
    cross = p.T @ q
    s = np.linalg.svd(cross, compute_uv=False)
    assume(s[1] + np.sign(np.linalg.det(cross)) * s[2] > 1e-3 * s[0])  # else many rotations are nearly as good
    expected, _ = Rotation.align_vectors(q, p)
    np.testing.assert_allclose(best_rotation(cross), expected.as_matrix(), atol=1e-9)


def test_best_rotation_undoes_any_rotation():
    random = np.random.default_rng(4)
    p = random.normal(0, 2, (10, 3))
    for degrees in (0.0, 1e-6, 30.0, 120.0, 179.999999, 180.0):
        r = random_rotation(random, degrees)
        np.testing.assert_allclose(best_rotation(p.T @ (p @ r.T)), r, atol=1e-9)
