"""Pictures: all that is drawn lies in its axes, no words lie on others, and what is drawn as measured is to scale."""

import io
import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb

import phytofit
import phytofit.plots
from phytofit.io import trait_table
from phytofit.plots import plot_plant, plot_plants
from phytofit.plots.page import QUALITY, digits, fitting, folded, interval, number, width_in
from phytofit.plots.phytomer import MEASURE, SHOWN
from phytofit.plots.plant import LEAF_COLORS
from phytofit.plots.views import widest_side
from phytofit.reconstruct.placing import Rejected
from phytofit.results import remark
from phytofit.segmentation import SegmentedLeaf
from phytofit.traits import Trait

NO_SHRINKING = (Phase.explicit, Phase.generate)  # a picture takes half a second
HAIR = 1e-6  # inches, to which places are rounded
TOUCH = 0.5  # pixels, by which neighbouring words may overlap: their hinting
HOSTILE = "plant $x_1$ [red]\x1b[31m\n<b>& ..\\frac 葉 \udcff \U0001f33f"


def rendered(figure):
    """The picture's bytes; every point that is drawn lies in its axes, every text in the picture and on no other."""
    with io.BytesIO() as file:
        figure.savefig(file, format="png", dpi=figure.dpi, metadata={"Software": None})
        made = file.getvalue()
    for ax in figure.axes:
        low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
        drawn = [line.get_xydata() for line in ax.lines if line.get_transform() == ax.transData]
        for collection in ax.collections:
            dots = isinstance(collection, PathCollection)
            drawn += [collection.get_offsets()] if dots else [path.vertices for path in collection.get_paths()]
        for places in drawn:
            assert np.all((places >= low - HAIR) & (places <= high + HAIR))
    words = [text for ax in figure.axes for text in ax.texts if text.get_text()] + figure.texts
    boxes = [text.get_window_extent() for text in words]
    for text, box in zip(words, boxes, strict=True):
        inside = box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1
        assert inside, text
    for (one, a), (other, b) in combinations(zip(words, boxes, strict=True), 2):
        apart = min(a.x1, b.x1) - max(a.x0, b.x0) < TOUCH or min(a.y1, b.y1) - max(a.y0, b.y0) < TOUCH
        assert apart, (one, other)
    return made


def words_of(figure):
    return [text.get_text() for ax in figure.axes for text in ax.texts] + [text.get_text() for text in figure.texts]


@pytest.fixture(scope="module")
def fitted():
    """A phytomer whose leaf stays in a plane."""
    fixed = {"leaf_length": 55.0, "leaf_angle": 50.0, "leaf_width": 6.0, "stem_length": 15.0, "stem_length_above": 13.0}
    return phytofit.fit(phytofit.simulate(fixed=fixed, n_points=1500, seed=4).points, "cm", threads=2)


@pytest.fixture(scope="module")
def bent(fitted):
    """The same, as one of the leaves that bend and twist; its errors are independent."""
    species = phytofit.load_species()
    x = species.model.neutral[: len(species.space)]
    x[: len(fitted.x)] = fitted.x
    return replace(fitted, species=species, x=x, trait_covariance=0.01 * np.eye(len(x)))


REMARKS = [remark("tip_unseen"), remark("leaf_mostly_unseen", share="9 %"), remark("views", said=HOSTILE * 9)]
TITLES = st.one_of(st.text(max_size=60), st.just(HOSTILE))
SHAPES = {
    "stem_diameter": st.floats(0.05, 8.0),
    "stem_length": st.floats(0.2, 80.0),
    "leaf_angle": st.floats(0.0, 175.0),
    "leaf_length": st.floats(0.5, 150.0),
    "leaf_width": st.floats(0.05, 20.0),
    "leaf_rotate_angle": st.floats(0.0, 9.0),
    "stem_length_above": st.floats(0.0, 80.0),
    "leaf_side_bend": st.floats(-120.0, 120.0),
    "leaf_twist": st.floats(-180.0, 180.0),
}


@settings(max_examples=6, phases=NO_SHRINKING)
@given(
    st.fixed_dictionaries(SHAPES),
    arrays(float, st.tuples(st.integers(1, 40), st.just(3)), elements=st.floats(-60.0, 60.0)),
    st.lists(st.sampled_from(REMARKS), max_size=9),
    TITLES,
    st.sampled_from([None, 1e-4, 3e5]),
)
def test_a_fit_of_any_shape_has_its_picture(bent, shape, points, remarks, title, scale):
    x = np.array([shape.get(name, value) for name, value in zip(bent.species.space.names, bent.x, strict=True)])
    odd = replace(bent, x=x, reference=points, observed=tuple(remarks))
    rendered(phytofit.plots.plot_fit(odd if scale is None else replace(odd, relative=True, scale=scale), title))


def test_what_is_drawn_as_measured_is_to_scale(fitted):
    figure = phytofit.plots.plot_fit(fitted, "leaf")
    side = figure.axes[0]
    assert np.allclose(side.get_position().size * figure.get_size_inches(), [side.get_xlim()[1], side.get_ylim()[1]])
    bar = next(line for line in side.lines if line.get_linewidth() == 2.0)
    said = next(text.get_text() for text in side.texts if re.fullmatch(r"\d+ cm", text.get_text()))
    inches_to_cm = np.ptp(bar.get_xdata()) / float(said.removesuffix(" cm"))
    drawn = [line.get_xydata() for line in side.lines if line.get_color() == MEASURE]
    midrib = max(drawn, key=len)
    rays = [line[1] - line[0] for line in drawn if len(line) == 2 and np.array_equal(line[0], midrib[0])]
    traits = {trait.name: trait.value for trait in fitted.traits}
    along = np.linalg.norm(np.diff(midrib, axis=0), axis=1).sum()
    assert along / inches_to_cm == pytest.approx(traits["leaf_length"], rel=1e-6)
    cosine = rays[0] @ rays[1] / np.prod(np.linalg.norm(rays[:2], axis=1))
    assert np.rad2deg(np.arccos(cosine)) == pytest.approx(traits["leaf_angle"], abs=1e-4)
    assert rays[0][0] == pytest.approx(0.0, abs=1e-9)  # the stem is upright
    assert "length" in " ".join(words_of(figure))


def test_quality_is_seen_by_mark_and_colour(fitted):
    """Each trait has its mark, a remark that of its grade; their colours differ."""
    unusual = remark("unusual", traits=["leaf_angle"], parameter="leaf_angle", value="170 deg")
    odd = replace(fitted, observed=(unusual, remark("tip_unseen")))
    words = words_of(phytofit.plots.plot_fit(odd, "leaf"))
    traits = {trait.name: trait.quality for trait in odd.traits}
    assert (traits["leaf_angle"], traits["leaf_length"], traits["stem_diameter"]) == ("poor", "check", "good")
    shown = [traits[name] for name in SHOWN]
    for quality, (mark, _) in QUALITY.items():
        graded = [one for one in odd.remarks if one.grade == quality]
        assert words.count(mark) == shown.count(quality) + len(graded)
    assert any("(unusual)" in word for word in words)
    assert len({color for _, color in QUALITY.values()}) == len({mark for mark, _ in QUALITY.values()}) == 3


def test_the_same_fit_gives_the_same_bytes(fitted):
    assert len({rendered(phytofit.plots.plot_fit(fitted, HOSTILE)) for _ in range(2)}) == 1


def test_the_search_has_its_picture(fitted):
    rendered(phytofit.plots.plot_convergence(fitted))


def plant_of(seed, n_leaves, n_points, *, size=30.0, unit="cm", up=None):
    """A plant whose stem leans, with leaves of any form, all of its points on the midribs and the stem."""
    random = np.random.default_rng(seed)
    lean = np.array([0.0, 1.0, 0.0]) + random.normal(0.0, 0.3, 3)
    stem = size * np.linspace(0.0, 1.0, 5)[:, np.newaxis] * lean + random.uniform(-50.0, 50.0, 3)
    leaves, points, labels = [], [stem], [np.ones(5)]
    for rank in range(1, n_leaves + 1):
        collar = stem[0] + rank / (n_leaves + 1) * (stem[-1] - stem[0])
        midrib = collar + np.cumsum(random.normal(0.0, 0.1 * size, (6, 3)), axis=0)
        midrib[0] = collar
        shares = random.random((n_points, 1))
        points.append(midrib[0] + shares * (midrib[-1] - midrib[0]))
        labels.append(np.full(n_points, rank + 1))
        flags = ("rank_uncertain", HOSTILE) if rank % 2 else ()
        leaves.append(
            SegmentedLeaf(rank, 0.0, collar, size * rank, size * rank, midrib[-1], midrib, size, n_points, flags)
        )
    stray = np.array([stem.mean(axis=0), stem[0] + 3.0 * size])
    cloud = phytofit.PointCloud(np.concatenate([*points, stray]), name="plant", unit=unit)
    labels = np.concatenate([*labels, [0, 0]]).astype(np.int64)
    return phytofit.Segmentation(
        cloud, labels, stem, 0.02 * size, np.array([0.0, 1.0, 0.0]), tuple(leaves), ("a note",), {"up": up}
    )


def traits_of(plant, *, number=1):
    unit = "rel" if plant.cloud.unit == "none" else "cm"
    traits = [Trait("plant", 0, "plant_height", 61.25, unit)]
    for leaf in plant.leaves[::-1]:
        flags = ("not_fitted", HOSTILE)
        diameter = Trait("internode", leaf.rank, "stem_diameter", 1.5 + leaf.rank, unit, 2.125, None, "good", flags)
        length = Trait("leaf", leaf.rank, "leaf_length", 1e5 * leaf.rank, unit, None, 2e9, "check", flags)
        angle = Trait("leaf", leaf.rank, "leaf_angle", 12.5, "deg", 10.0, 15.0, "poor", flags)
        traits += [diameter, length, angle]
    return trait_table("plant", traits, plant=number)


@settings(max_examples=3, phases=NO_SHRINKING)
@given(
    st.integers(0, 2**20),
    st.integers(1, 30),
    st.integers(1, 20),
    st.sampled_from([1e-3, 1.0, 200.0]),
    st.sampled_from(["cm", "none"]),
    TITLES,
)
def test_a_plant_of_any_shape_has_its_pictures(seed, n_leaves, n_points, size, unit, title):
    plant = plant_of(seed, n_leaves, n_points, size=size, unit=unit)
    for figure in (phytofit.plots.plot_segmentation(plant, title), plot_plant(plant, traits_of(plant), title)):
        rendered(figure)
        for ax in figure.axes[:2]:
            assert {text.get_text() for text in ax.texts} >= {str(leaf.rank) for leaf in plant.leaves}
            axis = next(line.get_xydata() for line in ax.lines if line.get_color() == "white")
            assert axis[0, 0] == pytest.approx(axis[-1, 0])  # upright
            assert axis[0, 1] < axis[-1, 1]
        dots = [c.get_offsets() for ax in figure.axes[:2] for c in ax.collections]
        assert sum(map(len, dots)) == 2 * (len(plant.cloud) - 1)  # all but the stray point far away


@pytest.mark.parametrize(("n_points", "n_views"), [(1, 1), (500, 60)])
def test_a_reconstruction_has_its_picture(n_points, n_views):
    random = np.random.default_rng(0)
    result = phytofit.Reconstruction(
        cloud=phytofit.PointCloud(random.normal(0.0, [20.0, 5.0, 30.0], (n_points, 3)), name="plant"),
        view=random.integers(0, n_views, n_points),
        n_views=np.ones(n_points, np.int64),
        camera=phytofit.load_camera("kinect-v2"),
        files=tuple(f"scan/{HOSTILE}_{i}.png" for i in range(n_views)),
        poses=np.tile(np.eye(4), (n_views, 1, 1)),
        pairs=(),
        turn=None,
        step_deg=-32.5,
        loop=(4.0, 0.25),
        contradicted=0.0,
        rejected=(Rejected(HOSTILE, "it does not fit the others"),) * 20,
        flags=(HOSTILE,),
        settings={},
    )
    figure = phytofit.plots.plot_reconstruction(result, HOSTILE)
    rendered(figure)
    assert any("left out: " in word for word in words_of(figure))
    assert {len(ax.collections[0].get_offsets()) for ax in figure.axes} == {n_points}


def test_a_cloud_of_many_points_has_its_picture_without_much_memory():
    """The widest side of 200,000 points: one number for each pair of them would be 300 GB."""
    points = np.random.default_rng(0).normal(0.0, [3.0, 1.0, 9.0], (200_000, 3))
    assert abs(widest_side(points, np.array([0.0, 0.0, 1.0]))[0]) > 0.99


def test_a_plant_s_table_says_what_was_measured_and_what_is_wrong():
    plant = plant_of(0, 2, 9)
    words = words_of(plot_plant(plant, traits_of(plant)))
    for word in ("61.2 cm", "2.50 cm ●", "(≥ 2.12)", "below leaf 1", "12.5 ✖", "(10.0–15.0)"):
        assert word in words
    assert any("not fitted" in word for word in words)
    assert not any("traits.csv" in word for word in words)


def test_a_stated_up_is_up():
    stem = plant_of(3, 2, 9, up=[0.0, 1.0, 0.0]).stem_path
    figure = phytofit.plots.plot_segmentation(plant_of(3, 2, 9, up=[0.0, 1.0, 0.0]))
    for ax in figure.axes[:2]:
        axis = next(line.get_xydata() for line in ax.lines if line.get_color() == "white")
        heights = (axis[:, 1] - axis[0, 1]) / (axis[-1, 1] - axis[0, 1])
        assert heights == pytest.approx((stem[:, 1] - stem[0, 1]) / (stem[-1, 1] - stem[0, 1]))


def test_each_of_several_plants_has_its_views_and_table():
    plants = [plant_of(seed, 2, 9) for seed in (1, 2)]
    table = pd.concat([traits_of(plant, number=i) for i, plant in enumerate(plants, start=1)])
    figure = plot_plant(plants, table, "pot")
    rendered(figure)
    assert {"pot, plant 1", "pot, plant 2"} <= set(words_of(figure))
    together = plot_plants(plants, HOSTILE)
    rendered(together)
    assert all({"1", "2"} <= {text.get_text() for text in ax.texts} for ax in together.axes)


def test_neighbouring_leaves_differ_in_grey():
    grey = np.array([0.299, 0.587, 0.114]) @ np.array([to_rgb(color) for color in LEAF_COLORS]).T
    assert np.abs(grey - np.roll(grey, 1)).min() > 0.15
    assert len(set(LEAF_COLORS)) > 12


@given(st.text(), st.floats(0.3, 4.0), st.integers(1, 4))
def test_text_fits(text, width, most):
    assert width_in(fitting(text, width)) <= width
    lines = folded(text, width, most)
    assert len(lines) <= most
    assert all(width_in(line) <= width for line in lines)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((47.5, 47.07, 47.93), ("47.50", "47.07–47.93")),
        ((58.0, 47.8, 69.7), ("58", "48–70")),
        ((3.556, 3.461, 3.652), ("3.56", "3.46–3.65")),
        ((4.8, 1.6, 10.2), ("4.8", "1.6–10.2")),
        ((0.4321, None, None), ("0.432", "")),
        ((24.0, 22.0, None), ("24.0", "≥ 22.0")),
        ((24.0, None, float("nan")), ("24.0", "")),
        ((24.0, None, 26.0), ("24.0", "≤ 26.0")),
        ((-1.5, -2.0, -1.0), ("−1.5", "−2.0–−1.0")),
        ((float("nan"), None, None), ("–", "")),
        ((0.0, None, None), ("0.0", "")),
        ((4.2e7, 4.1e7, None), ("4.20e7", "≥ 4.10e7")),
    ],
)
def test_numbers_are_as_precise_as_their_intervals(values, expected):
    decimals = digits(*values)
    assert (number(values[0], decimals), interval(*values[1:], decimals)) == expected
