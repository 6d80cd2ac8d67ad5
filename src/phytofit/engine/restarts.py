"""Where a richer leaf is refined from anew: hills of the posterior that do not rise from the paper's model."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from phytofit.engine.layout import State
from phytofit.engine.refine import Optimum
from phytofit.engine.sighting import across_leaf

__all__ = ["along_points", "longer", "longer_leaf", "longer_stem", "lower_insertion", "turned_blade"]

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


def turned_blade(optimum: Optimum) -> Iterator[State]:
    """With its blade turned about the midrib as the leaf's points lie across it, where that is far from how it is
    turned: a blade on edge is a local optimum of a level one, and the other way round."""
    state, space = optimum.state, optimum.posterior.space
    on_leaf = optimum.at.responsibilities[:, 1] > 0.5
    place, across = across_leaf(optimum.posterior, state)
    turn = np.zeros(2)
    spread = np.zeros((2, 2))
    for half in range(2):
        of_half = across[on_leaf & (place >= 0.5 * half) & (place <= 0.5 * (half + 1))]
        if len(of_half) < LEAST_ACROSS:
            return
        moment = np.cov(of_half.T)
        turn[half] = 0.5 * np.rad2deg(np.arctan2(2.0 * moment[0, 1], moment[0, 0] - moment[1, 1]))
        spread[half] = np.sqrt(np.linalg.eigvalsh(moment))
    if max(abs(turn)) < TURNED:
        return
    twist = 2.0 * ((turn[1] - turn[0] + 90.0) % 180.0 - 90.0)
    roll = state["leaf_roll"] + turn[0] - 0.25 * twist
    turned = state.changed(
        leaf_roll=(roll + 90.0) % 180.0 - 90.0,  # a blade has no upper side
        leaf_twist=state["leaf_twist"] + twist,
        leaf_width=2.0 * np.sqrt(3.0) * spread[:, 1].max(),  # as of a uniform strip
        leaf_noise=np.log(spread[:, 0].mean()),
    )
    yield turned.with_parameters(np.clip(turned.x, space.lower, space.upper))


def lower_insertion(optimum: Optimum) -> Iterator[State]:
    """With a leaf that leaves the stem lower down, along it at first, and then lies where it lay: a leaf that hugs the
    stem is a local optimum away from one that leaves it higher up, at once."""
    state, space = optimum.state, optimum.posterior.space
    below, length = state["stem_length"], state["leaf_length"]
    drop = min(LOWER * length, below - space.lower[space.index("stem_length")])
    if drop < LEAST_LOWER_CM:
        return
    from_tip = np.linspace(0.0, length - drop, 12)
    line = _midrib(optimum, state.x[np.newaxis], from_tip)[0]
    lower = state.changed(
        stem_length=below - drop,
        stem_length_above=state["stem_length_above"] + drop,
        collar_offset=1.0,
        leaf_angle=0.5 * state["leaf_angle"],
        leaf_length=length + drop,
    )
    yield _following(optimum, lower, BENT, line, from_tip)


def longer_leaf(optimum: Optimum) -> Iterator[State]:
    """With a longer leaf that goes on bending, where points are left over: some of them may be its tip's, too few and
    too far away to draw it on."""
    if optimum.state.share[2] >= LEFT_OVER:
        yield from (longer(optimum.state, times) for times in LONGER)


def longer(state: State, times: float) -> State:
    """With a leaf so many times as long, which bends as much in each cm: the bend is a thirtieth of the leaf's."""
    return state.changed(leaf_length=times * state["leaf_length"], leaf_rotate_angle=times * state["leaf_rotate_angle"])


def longer_stem(optimum: Optimum) -> Iterator[State]:
    """With a stem that goes on as far as points do that are left over, in line with it: beyond a gap they may be too
    far away to draw it on."""
    posterior, state = optimum.posterior, optimum.state
    pose, below = posterior.pose_of(state), state["stem_length"]
    points = ((posterior.points - pose[:3, 3]) @ pose[:3, :3])[optimum.at.responsibilities[:, 2] > 0.5]
    near = np.hypot(points[:, 0], points[:, 1]) < IN_LINE * (0.5 * state["stem_diameter"] + state.noise[0])
    height = points[near, 2]
    over, under = height[height > below + state["stem_length_above"]], height[height < 0.0]
    longer = state
    if len(over) >= LEAST_IN_LINE:
        longer = longer.changed(stem_length_above=over.max() - below)
    if len(under) >= LEAST_IN_LINE:
        foot = float(under.min())
        longer = longer.changed(stem_length=below - foot, shift=state.shift + foot * pose[:3, 2])
    if longer is not state:
        yield longer


def along_points(optimum: Optimum) -> Iterator[State]:
    """With a midrib that follows the leaf's points from the stem to their end, where it now leaves them: what a leaf
    that bends sharply, or curls back, needs."""
    posterior, state = optimum.posterior, optimum.state
    pose = posterior.pose_of(state)
    points = ((posterior.points - pose[:3, 3]) @ pose[:3, :3])[optimum.at.responsibilities[:, 0] < 0.5]
    line, from_tip = _line_of(points[:: max(1, len(points) // N_WALKED)], state)
    if not len(line):
        return
    leaf = posterior.organs(state)[1]
    j = np.argmin(np.linalg.norm(line[:, np.newaxis] - leaf.axis, axis=2), axis=1)
    astray = np.linalg.norm(line - leaf.axis[j], axis=1) - STRAY * leaf.half_width[j] - 2.0 * state.noise[1]
    tip_off = np.linalg.norm(line[-1] - leaf.axis[-1]) - from_tip[-1] - 2.0 * state.noise[1]
    if max(astray.max(), tip_off) < TIP_OFF * leaf.segment_lengths.sum():
        return
    length = float(np.linalg.norm(line[0] - leaf.axis[0]) + from_tip[0])
    as_long = longer(state, length / state["leaf_length"])
    yield _following(optimum, as_long, (*BENT, *SIDEWAYS), line, from_tip).changed(midrib_seen=1.0)


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


def _following(optimum: Optimum, state: State, names: Sequence[str], line: FloatArray, from_tip: FloatArray) -> State:
    """The state with those of the parameters `names` that the model has such that the midrib lies on a line (m, 3),
    given at lengths (m,) from its tip, cm; in the model's frame."""
    space, x = optimum.posterior.space, state.x
    changed = [space.index(name) for name in names if name in space.names]
    lower, upper, std = space.lower, space.upper, space.std[changed]

    def moved(values: FloatArray) -> FloatArray:
        xs = np.tile(x, (len(values), 1))
        xs[:, changed] = values
        return np.clip(xs, lower, upper)

    def misfit(values: FloatArray) -> FloatArray:
        gap = (_midrib(optimum, moved(values), from_tip) - line).reshape(len(values), -1)
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
    return state.with_parameters(moved(found.x[np.newaxis])[0])


def _midrib(optimum: Optimum, xs: FloatArray, from_tip: FloatArray) -> FloatArray:
    """Places (n, m, 3) on the midribs of xs (n, k) at lengths (m,) from their tips; straight on before their start."""
    model = optimum.posterior.model
    axis = model.organs(xs)[1].axis[:, ::-1]
    piece = xs[:, optimum.posterior.space.index("leaf_length")] / model.n_pieces
    at = from_tip / piece[:, np.newaxis]
    j = np.clip(at.astype(int), 0, model.n_pieces - 1)
    row = np.arange(len(xs))[:, np.newaxis]
    places: FloatArray = axis[row, j] + (at - j)[..., np.newaxis] * (axis[row, j + 1] - axis[row, j])
    return places
