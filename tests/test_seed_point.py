"""Which leaf is meant, in a cloud that shows others too."""

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import phytofit
from phytofit.cli import app
from phytofit.start.pose import start_poses
from phytofit.start.target_leaf import target_leaf_points

FIXED = {"leaf_length": 55.0, "leaf_angle": 50.0, "leaf_width": 6.0, "stem_diameter": 3.0, "stem_length": 15.0}
LENGTH_CM = 1.5


@pytest.fixture(scope="module")
def crowded():
    """A phytomer, a leaf of the same stem on its other side, a leaf that hangs free, and a piece of wall behind."""
    made = phytofit.simulate(fixed=FIXED, n_points=3000, noise_cm=0.3, seed=4)
    upright = (made.points - made.pose[:3, 3]) @ made.pose[:3, :3]
    leaf = upright[made.labels == 2]
    random = np.random.default_rng(4)
    opposite = leaf * [-1.0, -1.0, 1.0] + [0.0, 0.0, -7.0]
    free = leaf[leaf[:, 0] > 12.0] + [-4.0, 15.0, 6.0]
    wall = random.uniform([-25.0, -22.0, 0.0], [35.0, -20.0, 30.0], (800, 3))
    every = np.concatenate([upright, opposite[::2], free[::2], wall])
    on_leaf = made.organs[1].axis[15]
    return made, every @ made.pose[:3, :3].T + made.pose[:3, 3], on_leaf


@pytest.fixture(scope="module")
def seeded(crowded):
    """The fit of the crowded phytomer with a seed point on its leaf."""
    made, points, on_leaf = crowded
    return phytofit.fit(points, "cm", up=made.pose[:3, 2], seed_point=on_leaf, threads=2)


def length_of(result):
    return next(t.value for t in result.traits if t.name == "leaf_length")


def test_only_the_leaf_that_is_meant_is_measured(crowded, seeded):
    made, points, _ = crowded
    result = seeded
    assert length_of(result) == pytest.approx(55.0 - 1.5 / np.sin(np.deg2rad(50.0)), abs=LENGTH_CM)
    assert any("not on the seed point's leaf" in note for note in result.notes)
    assert len(result.reference) < len(points) - 1000
    alone = phytofit.fit(made.points, "cm", up=made.pose[:3, 2], threads=2)
    assert length_of(result) == pytest.approx(length_of(alone), abs=LENGTH_CM)


@pytest.mark.parametrize(("unit", "factor", "shift"), [("m", 0.01, 0.0), ("mm", 10.0, 4e8)])
def test_a_seed_point_is_in_the_unit_and_frame_of_the_cloud(crowded, seeded, unit, factor, shift):
    made, points, on_leaf = crowded
    in_cm = seeded
    other = phytofit.fit(
        points * factor + shift, unit, up=made.pose[:3, 2], seed_point=on_leaf * factor + shift, threads=2
    )
    assert length_of(other) == pytest.approx(length_of(in_cm), abs=0.01)
    assert len(other.reference) == len(in_cm.reference)


def test_a_leaf_that_touches_the_one_that_is_meant_is_left_out(crowded):
    made, _, on_leaf = crowded
    upright = (made.points - made.pose[:3, 3]) @ made.pose[:3, :3]
    turn = np.deg2rad(50.0)
    about = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    other = upright[made.labels == 2] @ about  # from the same place of the stem
    gap = np.linalg.norm(other[:, np.newaxis] - upright[made.labels == 2][::4], axis=2).min(axis=1)
    assert np.count_nonzero(gap < 0.5) > 20
    points = np.concatenate([upright, other]) @ made.pose[:3, :3].T + made.pose[:3, 3]
    result = phytofit.fit(points, "cm", up=made.pose[:3, 2], seed_point=on_leaf, threads=2)
    left = {tuple(point) for point in result.reference.tolist()}
    own, foreign = points[: len(upright)], points[len(upright) :]
    far = other[:, 0] ** 2 + other[:, 1] ** 2 > 10.0**2
    assert np.mean([tuple(p) in left for p in own.tolist()]) > 0.9
    assert np.mean([tuple(p) in left for p in foreign[far].tolist()]) < 0.05
    assert length_of(result) == pytest.approx(55.0 - 1.5 / np.sin(np.deg2rad(50.0)), abs=LENGTH_CM)


def is_told_that_others_touch(result):
    return "others_touch" in result.flags


def with_another(made, turn, lower):
    """The phytomer's points, those of its leaf, turned about the stem and lowered, after them, and which are which."""
    upright = (made.points - made.pose[:3, 3]) @ made.pose[:3, :3]
    other = upright[made.labels == 2] @ Rotation.from_euler("z", turn, degrees=True).as_matrix().T
    points = np.concatenate([upright, other - [0.0, 0.0, lower]]) @ made.pose[:3, :3].T + made.pose[:3, 3]
    return points, np.arange(len(points)) >= len(upright)


@pytest.mark.parametrize("n_points", [500, 1000, 3000])
@pytest.mark.parametrize(
    ("turn", "lower", "touches"),
    [(180.0, 4.0, True), (180.0, 12.0, False), (30.0, 0.0, True), (60.0, 0.0, True), (90.0, 1.0, True)],
)
def test_a_leaf_that_touches_or_is_beside_it_at_the_stem_is_flagged(turn, lower, touches, n_points):
    made = phytofit.simulate(fixed=FIXED, n_points=n_points, noise_cm=0.3, seed=4)
    points, _ = with_another(made, turn, lower)
    told = target_leaf_points(points, made.organs[1].axis[[15]], partial(start_poses, stem_radius=2.7))
    assert told.others_touch == touches


def test_what_touches_comes_with_the_result(seeded):
    assert is_told_that_others_touch(seeded)


def test_of_a_leaf_that_is_fused_with_the_one_that_is_meant_most_is_left_out(crowded):
    made, _, on_leaf = crowded
    points, foreign = with_another(made, 15.0, 2.0)
    told = target_leaf_points(points, on_leaf[np.newaxis], partial(start_poses, stem_radius=2.7))
    upright = (points - made.pose[:3, 3]) @ made.pose[:3, :3]
    beside = np.hypot(upright[:, 0], upright[:, 1]) > 4.0
    assert np.mean(told.points[foreign & beside]) < 0.33
    assert np.mean(told.points[~foreign]) > 0.95
    assert told.others_touch


@pytest.mark.parametrize("seed", [2, 3, 6, 8])
def test_a_wide_stem_among_leaves_keeps_its_ends(seed):
    random = np.random.default_rng(seed)
    made = phytofit.simulate(
        fixed={"stem_diameter": 5.0, "stem_length": 14.0, "stem_length_above": 12.0}, noise_cm=0.5, seed=seed
    )
    others = [with_another(made, turn, random.uniform(-8.0, 10.0)) for turn in (100.0, 220.0)]
    points = np.concatenate([made.points, *(every[foreign] for every, foreign in others)])
    told = target_leaf_points(points, made.organs[1].axis[[12]], partial(start_poses, stem_radius=2.7))
    assert np.mean(told.points[: len(made.points)][made.labels == 1]) > 0.97


def test_a_turned_copy_keeps_the_same_points(crowded):
    made, points, on_leaf = crowded
    turn = Rotation.from_euler("xyz", [40.0, -70.0, 200.0], degrees=True).as_matrix()
    kept = []
    for by in (np.eye(3), turn):
        result = phytofit.fit(points @ by.T, "cm", up=by @ made.pose[:3, 2], seed_point=by @ on_leaf, threads=2)
        kept.append(result.reference @ by)
    np.testing.assert_allclose(kept[0], kept[1], atol=1e-4)


def test_a_stray_point_far_away_changes_nothing(crowded):
    made, points, on_leaf = crowded
    strayed = np.concatenate([points, [[3000.0, 0.0, 0.0]]])
    result = phytofit.fit(strayed, "none", up=made.pose[:3, 2], seed_point=on_leaf, threads=2)
    assert length_of(result) == pytest.approx(55.0 - 1.5 / np.sin(np.deg2rad(50.0)), abs=LENGTH_CM)


def test_a_leaf_whose_base_is_hidden_has_its_own_stem():
    made = phytofit.simulate(fixed={"leaf_width": 6.0}, n_points=3000, noise_cm=0.5, seed=2)
    upright = (made.points - made.pose[:3, 3]) @ made.pose[:3, :3]
    hidden = (made.labels == 2) & (np.hypot(upright[:, 0], upright[:, 1]) < 5.0)
    true = {t.name: t.value for t in phytofit.measure(made.organs)}
    result = phytofit.fit(
        made.points[~hidden], "cm", up=made.pose[:3, 2], seed_point=made.organs[1].axis[15], threads=2
    )
    assert length_of(result) == pytest.approx(true["leaf_length"], abs=2.0)
    assert next(t.value for t in result.traits if t.name == "stem_diameter") == pytest.approx(2.8, abs=0.3)


def test_a_leaf_that_hangs_below_the_stem_keeps_its_tip():
    made = phytofit.simulate(
        fixed=FIXED | {"leaf_length": 80.0, "stem_length": 6.0, "leaf_rotate_angle": 5.0}, n_points=3000, seed=4
    )
    upright = (made.points - made.pose[:3, 3]) @ made.pose[:3, :3]
    leaf = upright[made.labels == 2]
    assert leaf[:, 2].min() < upright[made.labels == 1][:, 2].min() - 5.0
    points = np.concatenate([upright, leaf[::2] * [-1.0, -1.0, 1.0]]) @ made.pose[:3, :3].T + made.pose[:3, 3]
    result = phytofit.fit(points, "cm", up=made.pose[:3, 2], seed_point=made.organs[1].axis[15], threads=2)
    left = {tuple(point) for point in result.reference.tolist()}
    assert all(tuple(point) in left for point in points[: len(made.points)].tolist())
    assert result.estimate.tip_seen


def test_a_seed_point_of_a_whole_phytomer_changes_little(crowded):
    made, _, on_leaf = crowded
    with_seed = phytofit.fit(made.points, "cm", up=made.pose[:3, 2], seed_point=on_leaf, threads=2)
    without = phytofit.fit(made.points, "cm", up=made.pose[:3, 2], threads=2)
    assert not is_told_that_others_touch(with_seed)
    assert length_of(with_seed) == pytest.approx(length_of(without), abs=0.5)


def test_two_pieces_of_a_leaf(crowded):
    made, _, _ = crowded
    middle, far = made.organs[1].axis[[10, 24]]
    gap = np.abs((made.points - made.organs[1].axis[17]) @ made.organs[1].frame[17, :, 0]) < 4.0
    points = made.points[~gap | (made.labels == 1)]
    both = phytofit.fit(points, "cm", up=made.pose[:3, 2], seed_point=[middle, far], threads=2)
    assert length_of(both) == pytest.approx(55.0 - 1.5 / np.sin(np.deg2rad(50.0)), abs=LENGTH_CM)
    one = phytofit.fit(points, "cm", up=made.pose[:3, 2], seed_point=middle, threads=2)
    assert len(one.reference) < len(both.reference)


@pytest.mark.parametrize("wrong", ["abc", [1.0, 2.0], [[1.0, 2.0, np.nan]], [[[1.0, 2.0, 3.0]]]])
def test_what_is_no_point_is_refused(crowded, wrong):
    with pytest.raises(phytofit.SettingError, match="seed_point: expected three finite numbers"):
        phytofit.fit(crowded[0].points, "cm", seed_point=wrong)


def test_a_point_far_from_every_leaf_is_refused(crowded):
    with pytest.raises(
        phytofit.SettingError, match=r"in the unit of the cloud; seed point 1 of 1 is .* cm from the nearest one"
    ):
        phytofit.fit(crowded[0].points, "cm", seed_point=[500.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--seed-point", "1,2"], "expected X,Y,Z"),
        (["--seed-point", "1,2,x"], "expected X,Y,Z"),
        (["other.ply", "--seed-point", "1,2,3"], "one cloud"),
    ],
)
def test_the_command_says_what_it_expects(tmp_path, arguments, says):
    done = CliRunner().invoke(app, ["fit", "cloud.ply", *arguments, "--units", "cm", "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert says in " ".join(done.output.split())
    assert not list(tmp_path.iterdir())
