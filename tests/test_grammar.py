"""The grammar of whole plants, what it draws, and the organs and clouds that are made of it."""

import dataclasses
import json
import re

import numpy as np
import pandas as pd
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial import cKDTree
from typer.testing import CliRunner

import phytofit
from phytofit.cli import app
from phytofit.errors import SettingError, SpeciesError
from phytofit.models import LEAF, STEM
from phytofit.models.grammar import Plant, Profile, Symbol
from phytofit.models.plant import plant_organs
from phytofit.species import load_species
from phytofit.traits import measure

SPECIES = load_species()
GRAMMAR = SPECIES.plant
SIGNIFICANCE = 1e-3
GRASS = re.compile(r"(I(\d+) N\2 H\2 L\2 ?)+((W\d+ ?)+|T\d+)?")


def drawn(seed, **more):
    return GRAMMAR.draw(np.random.default_rng(seed), **more)


def values(plant, kind, name):
    return np.array([it.values[name] for it in plant.of(kind)])


@given(*[st.floats(0.5, 100.0)] * 3)
def test_a_profile_is_the_parabola_through_its_three_values(bottom, middle, top):
    profile = Profile(bottom, middle, top, 0.2, 0.1, 0.5)
    at = profile.typical(np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(at, np.maximum([bottom, middle, top], 0.05 * max(bottom, middle, top)), rtol=1e-9)
    rank = np.linspace(0.0, 1.0, 21)
    curve = np.polyval(np.polyfit([0.0, 0.5, 1.0], [bottom, middle, top], 2), rank)
    high = curve > 0.06 * max(bottom, middle, top)
    np.testing.assert_allclose(profile.typical(rank)[high], curve[high], rtol=1e-6)
    assert profile.typical(rank).min() > 0.0


def test_neighbours_share_what_the_file_says():
    profile, rank = Profile(10.0, 30.0, 20.0, 0.3, 0.2, 0.7), np.linspace(0.0, 1.0, 6)
    random = np.random.default_rng(0)
    logs = np.log([profile.drawn(rank, random) / profile.typical(rank) for _ in range(20_000)])
    apart = np.abs(np.subtract.outer(np.arange(6), np.arange(6)))
    np.testing.assert_allclose(np.cov(logs.T), 0.09 + 0.04 * 0.7**apart, atol=0.004)
    expected = stats.multivariate_normal(np.log(profile.typical(rank)), 0.09 + 0.04 * 0.7**apart)
    some = np.exp(logs[0]) * profile.typical(rank)
    density = expected.logpdf(np.log(some)) - np.log(some).sum()  # of a log-normal distribution
    assert profile.log_probability(rank, some) == pytest.approx(density, abs=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_a_drawn_plant_is_a_word_of_the_grammar(seed):
    plant = drawn(seed)
    assert GRASS.fullmatch(plant.text)
    collars, rolled = len(plant.of("blade")), len(plant.of("whorl"))
    assert [it.rank for it in (*plant.of("blade"), *plant.of("whorl"))] == list(range(1, collars + rolled + 1))
    assert rolled == min(plant.n_leaves - collars, GRAMMAR.n_rolled)
    assert collars == plant.n_leaves or not plant.of("tassel")
    assert GRAMMAR.least_leaves <= plant.n_leaves <= GRAMMAR.most_leaves
    assert all(number >= 0.0 for it in plant.symbols for number in it.values.values())


def test_leaves_are_as_many_and_turn_as_the_file_says():
    plants = [drawn(seed, n_collars=3) for seed in range(400)]
    mean, std = GRAMMAR.n_leaves
    number = np.array([it.n_leaves for it in plants])
    assert stats.ttest_1samp(number, mean).pvalue > SIGNIFICANCE
    assert number.std() == pytest.approx(std, rel=0.15)
    turned = np.concatenate([np.diff(values(it, "blade", "azimuth")) % 360.0 for it in plants])
    assert stats.kstest(turned, stats.norm(*GRAMMAR.divergence).cdf).pvalue > SIGNIFICANCE
    first = [it.of("blade")[0].values["azimuth"] / 360.0 for it in plants]
    assert stats.kstest(first, "uniform").pvalue > SIGNIFICANCE


def test_what_is_new_is_still_small():
    """The newest leaves of a young plant, beside the same of a grown one; and its stem is slim."""
    young = [drawn(seed, n_leaves=14, n_collars=6) for seed in range(100)]
    grown = [drawn(seed, n_leaves=14, n_collars=14) for seed in range(100)]
    ratio = np.median([values(it, "blade", "length") for it in young], axis=0)
    ratio = ratio / np.median([values(it, "blade", "length")[:6] for it in grown], axis=0)
    np.testing.assert_allclose(ratio, [1.0, 1.0, 1.0, 1.0, 0.75, 0.5], atol=0.08)
    seedling = [drawn(seed, n_leaves=14, n_collars=2).of("internode")[0].values["diameter"] for seed in range(100)]
    assert np.median(seedling) < 0.6 * np.median([it.of("internode")[0].values["diameter"] for it in grown])


@pytest.mark.parametrize("seed", range(10))
def test_a_plant_that_no_grass_is_like_is_less_probable(seed):
    """Its lengths in another order; leaves all on one side; a stem thick at the top."""
    plant = drawn(seed, n_leaves=12, n_collars=12)
    order = np.random.default_rng(seed).permutation(12)

    def changed(kind, name, new):
        numbers = iter(new)
        symbols = [
            dataclasses.replace(it, values={**it.values, name: float(next(numbers))}) if it.kind == kind else it
            for it in plant.symbols
        ]
        return GRAMMAR.log_probability(Plant(tuple(symbols), plant.n_leaves))

    here = GRAMMAR.log_probability(plant)
    assert changed("blade", "length", values(plant, "blade", "length")) == pytest.approx(here)
    assert changed("blade", "length", values(plant, "blade", "length")[order]) < here - 3.0
    assert changed("blade", "azimuth", np.full(12, 30.0)) < here - 100.0
    assert changed("internode", "diameter", np.linspace(1.0, 3.0, 12)) < here - 10.0


@pytest.mark.parametrize("seed", range(6))
def test_the_organs_have_the_sizes_of_the_symbols(seed):
    """Without what leaves do beyond the paper's model, and measured by the code that measures fits."""
    plant = drawn(seed)
    organs = plant_organs(plant, SPECIES.model, lean=(8.0, -5.0))
    stem, blades = organs[0].organ, [it.organ for it in organs if it.kind == "blade"]
    found = {(t.rank, t.name): t.value for t in measure((stem, *blades))}
    for symbol in plant.of("blade"):
        true = symbol.values
        assert found[symbol.rank, "leaf_length"] == pytest.approx(true["length"], rel=0.01)
        assert found[symbol.rank, "leaf_width"] == pytest.approx(true["width"], rel=0.01)
        assert found[symbol.rank, "leaf_insertion_angle"] == pytest.approx(true["angle"], abs=1.5)
        assert found[symbol.rank, "leaf_curvature"] * true["length"] == pytest.approx(true["bend"], rel=0.06)
    collar = np.maximum.accumulate(np.cumsum(values(plant, "internode", "length")) + values(plant, "sheath", "length"))
    nodes = np.append(0.0, np.cumsum(stem.segment_lengths))
    for height, symbol, blade in zip(collar, plant.of("blade"), blades, strict=True):
        center = np.array([np.interp(height, nodes, column) for column in stem.axis.T])
        out = blade.axis[0] - center
        assert np.linalg.norm(out) == pytest.approx(np.interp(height, nodes, stem.half_width), abs=1e-6)
        azimuth = np.rad2deg(np.arctan2(out[1], out[0]))
        assert (azimuth - symbol.values["azimuth"] + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1.0)


def test_a_stem_is_as_thick_as_its_internodes_and_the_sheaths_around_them():
    plant = drawn(3, n_leaves=10, n_collars=10)
    stem = plant_organs(plant, SPECIES.model)[0].organ
    node = np.cumsum(values(plant, "internode", "length"))
    middle = node - 0.5 * values(plant, "internode", "length")
    collar = np.maximum.accumulate(node + values(plant, "sheath", "length"))
    nodes = np.append(0.0, np.cumsum(stem.segment_lengths))
    around = [np.count_nonzero((node < z - 0.3) & (collar > z + 0.3)) for z in middle]
    clear = [np.all(np.abs(np.concatenate([node, collar]) - z) > 0.3) for z in middle]
    expected = values(plant, "internode", "diameter") + 0.2 * np.array(around)
    assert np.count_nonzero(clear) > 5
    np.testing.assert_allclose((2.0 * np.interp(middle, nodes, stem.half_width))[clear], expected[clear], rtol=0.02)


def test_one_seed_gives_the_same_bytes():
    a, b, c = (phytofit.simulate_plant(n_points=500, n_views=3, seed=seed) for seed in (5, 5, 6))
    assert a.points.tobytes() == b.points.tobytes() != c.points.tobytes()
    assert a.plant == b.plant


@pytest.mark.parametrize("seed", range(3))
def test_points_lie_on_the_organ_of_their_label(seed):
    made = phytofit.simulate_plant(n_points=4000, noise_cm=0.0, outlier_share=0.1, seed=seed)
    assert np.count_nonzero(made.labels == 0) == 400
    for organ in made.leaves:
        mesh = phytofit.models.mesh([organ.organ])
        points = made.points[made.labels == organ.rank + 1]
        dense = trimesh.sample.sample_surface(mesh, 20_000, seed=0)[0]
        assert cKDTree(dense).query(points)[0].max() < 0.6  # of one point to each mm² or so
    assert set(made.labels) <= {0, 1, *(it.rank + 1 for it in made.leaves)}
    area = {kind: sum(float(it.organ.area) for it in made.organs if it.organ.kind == kind) for kind in (STEM, LEAF)}
    share = np.mean(made.labels[made.labels > 0] == 1)
    assert share == pytest.approx(area[STEM] / (area[STEM] + area[LEAF]), abs=0.03)


def test_cameras_do_not_see_the_leaf_behind_the_leaf():
    """From one side a part of the stem's back, and of what is behind blades, has no points."""
    given = {"n_leaves": 14, "n_collars": 10, "n_points": 6000, "noise_cm": 0.0, "random_orientation": False, "seed": 2}
    whole, seen = phytofit.simulate_plant(**given), phytofit.simulate_plant(**given, n_views=1)
    assert whole.plant == seen.plant
    feet = [made.points[(made.labels == 1) & (made.points[:, 2] < 12.0)] for made in (whole, seen)]  # it leans above
    angles = [np.arctan2(*foot[:, :2].T) for foot in feet]
    empty = [np.mean(np.histogram(angle, 24, (-np.pi, np.pi))[0] == 0) for angle in angles]
    assert empty[0] == 0.0
    assert empty[1] > 0.1


def test_the_truth_is_that_of_the_plant():
    made = phytofit.simulate_plant(n_points=2000, seed=4)
    found = {(t.organ, t.rank, t.name): t for t in made.traits}
    upright = (made.points - made.pose[:3, 3]) @ made.pose[:3, :3]
    assert found["plant", 0, "leaf_count"].value == len(made.leaves)
    assert found["plant", 0, "plant_height"].value == pytest.approx(upright[:, 2].max(), abs=2.0)
    areas = [t.value for t in made.traits if t.name == "leaf_area"]
    assert found["plant", 0, "plant_leaf_area"].value == pytest.approx(sum(areas))
    assert sum(areas) == pytest.approx(sum(float(it.organ.area) for it in made.leaves), rel=0.05)
    collars = [t.value for t in made.traits if t.name == "collar_height"]
    assert len(collars) == len(made.plant.of("blade"))
    assert np.all(np.diff(collars) >= 0.0)
    assert {t.method for t in made.traits} == {"truth"}


def test_a_plant_can_be_segmented():
    """A simple one, seen whole: each leaf with a collar is found, and most of its points."""
    made = phytofit.simulate_plant(n_leaves=7, n_collars=7, n_points=12_000, noise_cm=0.1, seed=1)
    found = phytofit.segment(phytofit.from_points(made.points, "cm"))
    assert abs(len(found.leaves) - len(made.plant.of("blade"))) <= 1


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"n_leaves": 5, "n_collars": 6}, "expected 1 to 5"),
        ({"n_leaves": 0}, "leaves"),
        ({"n_points": 0}, "points"),
        ({"noise_cm": -1.0}, "noise"),
        ({"outlier_share": 1.0}, "outliers"),
    ],
)
def test_what_can_not_be_is_refused(given, said):
    with pytest.raises(SettingError, match=said):
        phytofit.simulate_plant(**given)


def test_a_species_without_a_grammar_draws_no_plants():
    with pytest.raises(SettingError, match=r"\[plant\]"):
        phytofit.simulate_plant(dataclasses.replace(SPECIES, plant=None))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('unit = "deg"\nmean = 180.0', 'unit = "rad"\nmean = 180.0', "be 'deg'"),
        ("[plant.profiles.leaf_bend]", "[plant.profiles.leaf_bent]", "leaf_bend"),
        ("least = 4", "least = 40", "least <= mean <= most"),
        ("rolled_leaves = 2", "rolled_leaves = -2", "rolled_leaves"),
    ],
)
def test_a_section_that_can_not_be_is_refused_with_its_key(tmp_path, old, new, said):
    text = phytofit.bundled.species_folder().joinpath("sorghum.toml").read_text(encoding="utf-8")
    assert old in text
    file = tmp_path / "mine.toml"
    file.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(SpeciesError, match=said) as error:
        load_species(file)
    assert "plant" in str(error.value)
    assert "mine.toml" in str(error.value)


def run(*arguments):
    return CliRunner().invoke(app, [str(it) for it in arguments])


def test_the_command_writes_plants_with_their_truth(tmp_path):
    done = run("simulate", "--plant", "-n", "2", "--points", "1500", "--leaves", "8", "--unfolded", "5", "-o", tmp_path)
    assert done.exit_code == 0, done.output
    truth = pd.read_csv(tmp_path / "truth.csv")
    assert list(truth["cloud"].unique()) == ["plant_0001", "plant_0002"]
    counted = truth[truth["trait"] == "leaf_count"]["value"]
    assert list(counted) == [7.0, 7.0]
    cloud = phytofit.read_cloud(tmp_path / "plant_0001.ply", "cm")
    assert set(cloud.labels) == {*range(1, 9)}
    mesh = trimesh.load(tmp_path / "plant_0001_mesh.ply")
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(np.ptp(cloud.points, axis=0), abs=5.0)
    said = json.loads((tmp_path / "plant_0001.json").read_text(encoding="utf-8"))
    assert [it["symbol"] for it in said["symbols"][:4]] == ["internode", "node", "sheath", "blade"]
    again = run("simulate", "-n", "1", "--points", "300", "-o", tmp_path)  # in place of the plants
    assert again.exit_code == 0, again.output
    assert {p.name for p in tmp_path.glob("*_0*")} == {"phytomer_0001.ply", "phytomer_0001.json"}


@pytest.mark.parametrize(
    "given", [["--plant", "--set", "leaf_length=50"], ["--leaves", "5"], ["--plant", "--spheres", "2"]]
)
def test_options_of_the_other_kind_are_refused(tmp_path, given):
    done = run("simulate", *given, "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "--plant" in done.output
    assert not (tmp_path / "out").exists()


def test_a_symbol_is_one_of_the_grammar():
    assert {it.kind for it in drawn(0).symbols} <= {"internode", "node", "sheath", "blade", "whorl", "tassel"}
    assert isinstance(drawn(0).symbols[0], Symbol)
