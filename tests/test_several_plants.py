"""Several plants in one cloud: found and told apart; a plant in pieces is one."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import phytofit
from phytofit import fitting
from phytofit.cli import app
from test_segmentation import cloud_of, plant

TWO = Path(__file__).parents[2] / "shared" / "data" / "awkward" / "60_two_plants" / "two.xyz"
OWN = 0.97  # share of a plant's points that come back with it
WITH_POT = 0.95  # the same where pots touch: a pot's rim may be nearer to the next stem
SIDE_CM = 70.0  # between plants whose leaves do not touch


def pot(radius=6.0, height=8.0, n_wall=6000, n_earth=2000):
    """Points (n, 3) of a pot full of earth, whose top is at 0."""
    random = np.random.default_rng(7)
    angle = random.uniform(0.0, 2.0 * np.pi, n_wall + n_earth)
    out = radius * np.sqrt(random.uniform(0.0, 1.0, n_wall + n_earth))
    out[:n_wall] = radius
    z = np.zeros(n_wall + n_earth)
    z[:n_wall] = random.uniform(-height, 0.0, n_wall)
    return np.stack([out * np.cos(angle), out * np.sin(angle), z], axis=1)


def grown(n_leaves, size=1.0, seed=0):
    """A plant's points, its stem's base at the origin."""
    points, labels, _, collars = plant(n_leaves=n_leaves, n_points=4000, seed=seed, lean=0.0)
    return size * points, labels, size * collars


def told_apart(clouds, parts):
    """Of each part (n, 3) the share of its points that are in the cloud at its place."""
    assert len(clouds) == len(parts)
    shares = []
    for cloud, part in zip(clouds, parts, strict=True):
        own = {tuple(point) for point in np.round(cloud.points, 9).tolist()}
        shares.append(np.mean([tuple(point) in own for point in np.round(part, 9).tolist()]))
    return np.array(shares)


def test_three_plants_of_different_heights_in_a_row():
    sizes = ((4, 1.0), (3, 0.4), (5, 0.8))
    parts = [grown(n, size, i)[0] + np.array([0.0, i * SIDE_CM, 3.0 * i]) for i, (n, size) in enumerate(sizes)]
    found = phytofit.separate_plants(cloud_of(np.concatenate(parts)))
    assert (told_apart(found, parts) > OWN).all()
    assert "3 plants were found, numbered along y" in found[0].notes


def test_plants_in_pots_that_touch():
    parts = []
    for i, n in enumerate([3, 4, 3]):
        shoot = 0.2 * grown(n, seed=i)[0]
        parts.append(np.concatenate([shoot, pot()]) + np.array([12.0 * i, 0.0, 0.0]))
    found = phytofit.separate_plants(cloud_of(np.concatenate(parts)))
    assert (told_apart(found, parts) > WITH_POT).all()


def test_plants_whose_leaves_touch_lose_none_of_their_stems():
    (one, labels, _), (two, other, _) = grown(4), grown(4, seed=1)
    two = two + np.array([63.0, 0.0, 0.0])  # leaves are about 35 cm long, to either side
    assert one[:, 0].max() > two[:, 0].min()
    found = phytofit.separate_plants(cloud_of(np.concatenate([one, two])), up="z")
    assert (told_apart(found, [one[labels == 1], two[other == 1]]) > OWN).all()
    assert (
        told_apart(found, [one, two]) > 0.85
    ).all()  # of leaves that reach into each other the nearer stem takes all


@pytest.mark.parametrize("seed", range(2))
def test_a_plant_in_pieces_is_one_plant_in_any_orientation(seed):
    """A leaf is off, and in another copy the upper half: neither stands on a stem of its own that begins beside it."""
    points, labels, collars = grown(4, seed=seed)
    turned = Rotation.random(rng=seed)
    middle = 0.5 * (collars[1, 2] + collars[2, 2])
    cut = np.abs(points[:, 2] - middle) > 2.0
    away = np.linalg.norm(points - collars[1], axis=1) > 5.0
    for kept in (away | (labels != 3), cut | (labels > 1)):
        assert 0.9 < kept.mean() < 1.0
        cloud = cloud_of(turned.apply(points[kept]))
        assert phytofit.separate_plants(cloud) == (cloud,)


def test_each_plant_has_its_folder_and_its_rows(tmp_path):
    parts = [grown(3, 1.0, i)[0] + [i * SIDE_CM, 0.0, 0.0] for i in range(2)]
    phytofit.write_cloud(tmp_path / "bench.ply", cloud_of(np.concatenate(parts)))
    arguments = ["segment", str(tmp_path / "bench.ply"), "--units", "cm", "--out", str(tmp_path / "out")]
    done = CliRunner(env={"COLUMNS": "200"}).invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "bench, plant 2: 3 leaves" in done.output
    table = pd.read_csv(tmp_path / "out" / "leaves.csv")
    assert table.groupby("plant")["rank"].apply(list).to_dict() == {1: [1, 2, 3], 2: [1, 2, 3]}
    made = tmp_path / "out" / "bench"
    assert {path.name for path in made.iterdir()} == {
        "plant_1",
        "plant_2",
        "leaves.csv",
        "plants.png",
        "segmentation.json",
    }
    back = [phytofit.read_cloud(made / f"plant_{i}" / "plant.ply", "cm") for i in (1, 2)]
    assert [len(cloud) for cloud in back] == [len(part) for part in parts]
    assert [cloud.labels.max() for cloud in back] == [4, 4]
    assert (made / "plants.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.skipif(not TWO.exists(), reason="no data in ../shared/data")
def test_two_maize_plants_25_cm_apart():
    cloud = phytofit.read_cloud(TWO, "mm")
    found = phytofit.separate_plants(cloud)
    parts = np.split(cloud.points[np.argsort(cloud.points[:, 1])], [2500])
    assert sorted(len(one) for one in found) == [2500, 2500]
    assert (told_apart(found, parts) == 1.0).all()
    assert [len(phytofit.segment(one).leaves) >= 3 for one in found] == [True, True]


@pytest.mark.skipif(not TWO.exists(), reason="no data in ../shared/data")
def test_a_fit_of_two_plants_is_refused_for_what_it_is(monkeypatch):
    """Whatever the fit stumbled over: two plants are the cause."""

    def stumbles(*of, **how):
        raise phytofit.NoPhytomerError("no stem in this cloud")

    monkeypatch.setattr(fitting, "_fit", stumbles)
    cloud = phytofit.read_cloud(TWO, "mm")
    with pytest.raises(phytofit.NoPhytomerError, match=r"^this looks like 2 plants: .*phytofit\.run"):
        phytofit.fit(cloud)
    with pytest.raises(phytofit.NoPhytomerError, match="no stem in this cloud"):
        phytofit.fit(phytofit.separate_plants(cloud)[0])
