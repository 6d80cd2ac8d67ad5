"""Where a richer leaf is begun: hills of the likelihood that do not rise from the paper's model."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from phytofit.engine.likelihood import SHIFT, CloudLikelihood, State
from phytofit.engine.sighting import across_leaf
from phytofit.species import Species

__all__ = ["along_points", "longer_leaf", "longer_stem", "lower_insertion", "turned_blade"]

FloatArray = NDArray[np.float64]
TURNED = 30.0  # degrees, from which a blade is also begun turned
LEAST_ACROSS = 20  # points that say how a half of it lies
LOWER, LEAST_LOWER_CM = 0.12, 2.0  # of the leaf's length, by which its insertion is also tried lower down
PRIOR_CM = 0.2  # by which its midrib may be moved to make it a spread of the prior more plausible
LEFT_OVER, LONGER = 0.005, (1.12, 1.3)  # share of outliers; times the leaf's length, as which it is begun
IN_LINE, LEAST_IN_LINE = 2.0, 20  # radii and noise levels from the stem's axis; points beyond its end that are its
N_WALKED, NEIGHBORS, LINK = 1500, 10, 3.0  # points of the leaf; neighbours; typical distances that link two of them
N_BANDS, IN_BAND, LEAST_IN_BAND = 25, 8, 5  # of equal distance from the stem, along the leaf; points wanted, needed
STRAY, TIP_OFF = 1.0, 0.05  # half widths off the midrib; of the leaf's length: so far off its points' line may be
SIDEWAYS = ("leaf_side_bend", "leaf_side_bow")
BENT = ("leaf_angle", "leaf_length", "leaf_rotate_angle", "leaf_bow", "leaf_wave", "leaf_base_bend")


def turned_blade(species: Species, likelihood: CloudLikelihood, state: State, scores: FloatArray) -> Iterator[State]:
    """The state with its blade turned about the midrib as the leaf's points lie across it, where that is far from how
    it is turned: a blade on edge is a local optimum of a level one, and the other way round."""
    names = species.space.names
    if "leaf_twist" not in names:
        return
    on_leaf = state.belongs(scores)[1] > 0.5
    place, across = across_leaf(likelihood, state)
    turn = np.zeros(2)
    spread = np.zeros((2, 2))
    for half in range(2):
        those = across[on_leaf & (place >= 0.5 * half) & (place <= 0.5 * (half + 1))]
        if len(those) < LEAST_ACROSS:
            return
        moment = np.cov(those.T)
        turn[half] = 0.5 * np.rad2deg(np.arctan2(2.0 * moment[0, 1], moment[0, 0] - moment[1, 1]))
        spread[half] = np.sqrt(np.linalg.eigvalsh(moment))
    if max(abs(turn)) < TURNED:
        return
    twist = 2.0 * ((turn[1] - turn[0] + 90.0) % 180.0 - 90.0)
    theta = state.theta.copy()
    x = np.concatenate([state.x, species.space.mean[state.n_parameters :]])
    roll = x[names.index("leaf_roll")] + turn[0] - 0.25 * twist
    x[names.index("leaf_roll")] = (roll + 90.0) % 180.0 - 90.0  # a blade has no upper side
    x[names.index("leaf_twist")] += twist
    x[names.index("leaf_width")] = 2.0 * np.sqrt(3.0) * spread[:, 1].max()  # as of a uniform strip
    theta[-4] = np.log(spread[:, 0].mean())
    inside = np.clip(x, species.space.lower, species.space.upper)
    yield State(np.concatenate([inside, theta[state.n_parameters :]]), state.pose, state.center)


def lower_insertion(species: Species, state: State) -> Iterator[State]:
    """The state with a leaf that leaves the stem lower down, along it at first, and then lies where it lay: a leaf that
    hugs the stem is a local optimum away from one that leaves it higher up, at once."""
    space, x = species.space, state.x
    drop = min(LOWER * x[3], x[1] - space.lower[1])
    if drop < LEAST_LOWER_CM:
        return
    from_tip = np.linspace(0.0, x[3] - drop, 12)
    there = _midrib(species, x[np.newaxis], from_tip)[0]
    other = x.copy()
    other[1], other[6], other[space.index("collar_offset")] = x[1] - drop, x[6] + drop, 1.0
    other[2], other[3] = 0.5 * x[2], x[3] + drop
    bent = [space.index(name) for name in BENT if name in space.names]
    yield _with_x(state, _following(species, other, bent, there, from_tip))


def longer_leaf(state: State) -> Iterator[State]:
    """The state with a longer leaf that goes on bending, where points are left over: some of them may be its tip's, too
    few and too far away to draw it on."""
    if state.share[2] < LEFT_OVER:
        return
    for times in LONGER:
        theta = state.theta.copy()
        theta[[3, 5]] *= times  # the bend is a thirtieth of the leaf's
        yield State(theta, state.pose, state.center)


def longer_stem(likelihood: CloudLikelihood, state: State, scores: FloatArray) -> Iterator[State]:
    """The state with a stem that goes on as far as points do that are left over, in line with it: beyond a gap they may
    be too far away to draw it on."""
    pose, x = likelihood.pose_of(state), state.x
    points = ((likelihood.points - pose[:3, 3]) @ pose[:3, :3])[state.belongs(scores)[2] > 0.5]
    near = np.hypot(points[:, 0], points[:, 1]) < IN_LINE * (0.5 * x[0] + state.noise[0])
    height = points[near, 2]
    above, below = height[height > x[1] + x[6]], height[height < 0.0]
    theta = state.theta.copy()
    if len(above) >= LEAST_IN_LINE:
        theta[6] = above.max() - x[1]
    if len(below) >= LEAST_IN_LINE:
        theta[1] -= below.min()
        theta[SHIFT] += below.min() * pose[:3, 2]
    if not np.array_equal(theta, state.theta):
        yield State(theta, state.pose, state.center)


def along_points(species: Species, likelihood: CloudLikelihood, state: State, scores: FloatArray) -> Iterator[State]:
    """The state with a midrib that follows the leaf's points from the stem to their end, where it now leaves them: what
    a leaf that bends sharply, or curls back, needs."""
    space, k = species.space, state.n_parameters
    pose = likelihood.pose_of(state)
    points = ((likelihood.points - pose[:3, 3]) @ pose[:3, :3])[state.belongs(scores)[0] < 0.5]
    line, from_tip = _line_of(points[:: max(1, len(points) // N_WALKED)], state)
    if not len(line):
        return
    leaf = species.model.organs(state.x)[1].row(0)
    j = np.argmin(np.linalg.norm(line[:, np.newaxis] - leaf.axis, axis=2), axis=1)
    astray = np.linalg.norm(line - leaf.axis[j], axis=1) - STRAY * leaf.half_width[j] - 2.0 * state.noise[1]
    tip_off = np.linalg.norm(line[-1] - leaf.axis[-1]) - from_tip[-1] - 2.0 * state.noise[1]
    length = leaf.segment_lengths.sum()
    if max(astray.max(), tip_off) < TIP_OFF * length:
        return
    x = state.x.copy()
    start = np.linalg.norm(line[0] - leaf.axis[0]) + from_tip[0]
    x[3], x[5] = start, x[5] * start / x[3]
    bent = [space.index(name) for name in (*BENT, *SIDEWAYS) if name in space.names]
    theta = np.concatenate([_following(species, x, bent, line, from_tip), state.theta[k:]])
    theta[k] = 1.0
    yield State(theta, state.pose, state.center)


def _line_of(points: FloatArray, state: State) -> tuple[FloatArray, FloatArray]:
    """Middles (m, 3) of bands of the points (n, 3), from the stem outwards, and their lengths (m,) from the leaf's end;
    none where too few points hang together."""
    nothing = np.zeros((0, 3)), np.zeros(0)
    if len(points) <= 2 * NEIGHBORS:
        return nothing
    gap, near = cKDTree(points).query(points, k=NEIGHBORS + 1)
    link = gap[:, 1:] < LINK * np.median(gap[:, -1])
    rows = np.repeat(np.arange(len(points)), NEIGHBORS)
    graph = coo_array((gap[:, 1:][link], (rows[link.ravel()], near[:, 1:][link])), shape=(len(points),) * 2).tocsr()
    piece = connected_components(graph, directed=False)[1]
    largest = piece == np.argmax(np.bincount(piece))
    rest = np.hypot(points[:, 0], points[:, 1])
    first = np.flatnonzero(largest)[np.argsort(rest[largest])[:NEIGHBORS]]
    walked = dijkstra(graph, directed=False, indices=first, min_only=True)
    n_bands = min(N_BANDS, int(np.count_nonzero(largest)) // IN_BAND)
    band = np.where(largest, walked / walked[largest].max() * (n_bands - 1e-9), -1.0).astype(int)
    enough = [b for b in range(n_bands) if np.count_nonzero(band == b) >= LEAST_IN_BAND]
    if len(enough) < max(3, n_bands // 2):
        return nothing
    line = np.stack([points[band == b].mean(axis=0) for b in enough])
    line[1:-1] = 0.25 * line[:-2] + 0.5 * line[1:-1] + 0.25 * line[2:]
    step = np.linalg.norm(np.diff(line, axis=0), axis=1)
    from_tip = np.append(np.cumsum(step[::-1])[::-1], 0.0) + 0.5 * np.median(step)
    return line, from_tip


def _following(
    species: Species, x: FloatArray, changed: list[int], line: FloatArray, from_tip: FloatArray
) -> FloatArray:
    """Parameters (k,) with those that are `changed` such that the midrib lies on a line (m, 3), given at lengths (m,)
    from its tip, cm; in the model's frame."""
    space = species.space
    lower, upper, std = space.lower, space.upper, space.std[changed]

    def moved(values: FloatArray) -> FloatArray:
        xs = np.tile(x, (len(values), 1))
        xs[:, changed] = values
        return np.clip(xs, lower, upper)

    def misfit(values: FloatArray) -> FloatArray:
        gap = (_midrib(species, moved(values), from_tip) - line).reshape(len(values), -1)
        residuals: FloatArray = np.hstack([gap, PRIOR_CM * (values - space.mean[changed]) / std])
        return residuals

    def slope(values: FloatArray) -> FloatArray:
        step = 1e-4 * std
        both = misfit(np.concatenate([values + np.diag(step), values - np.diag(step)]))
        change: FloatArray = ((both[: len(step)] - both[len(step) :]) / (2.0 * step[:, np.newaxis])).T
        return change

    found = least_squares(
        lambda values: misfit(values[np.newaxis])[0], x[changed], slope, method="lm", x_scale=std, max_nfev=50
    )
    best: FloatArray = moved(found.x[np.newaxis])[0]
    return best


def _midrib(species: Species, xs: FloatArray, from_tip: FloatArray) -> FloatArray:
    """Places (n, m, 3) on the midribs of xs (n, k) at lengths (m,) from their tips; straight on before their start."""
    axis = species.model.organs(xs)[1].axis[:, ::-1]
    piece = xs[:, 3] / species.model.n_pieces
    at = from_tip / piece[:, np.newaxis]
    j = np.clip(at.astype(int), 0, species.model.n_pieces - 1)
    row = np.arange(len(xs))[:, np.newaxis]
    places: FloatArray = axis[row, j] + (at - j)[..., np.newaxis] * (axis[row, j + 1] - axis[row, j])
    return places


def _with_x(state: State, x: FloatArray) -> State:
    return State(np.concatenate([x, state.theta[state.n_parameters :]]), state.pose, state.center)
