"""Results in Python: a short table by its repr, HTML in a notebook, a frame, a picture; files taken as clouds."""

from html.parser import HTMLParser

import numpy as np
import pytest

import phytofit
from phytofit.display import Shown, Summary
from phytofit.errors import SettingError, UnitError
from phytofit.io import COLUMNS, trait_table
from phytofit.pipeline import PlantRun
from phytofit.reconstruct import CAMERAS, Reconstruction
from phytofit.results import Placed, remark
from phytofit.segmentation import Segmentation, SegmentedLeaf

HOSTILE = "<b>[red]x[/]\x1b[31m\n=cmd"
MOST_CHARACTERS = 3000


@pytest.fixture(scope="module")
def leaf_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("clouds") / "leaf.xyz"
    np.savetxt(path, phytofit.simulate(seed=4, n_points=1200, noise_cm=0.2).points)
    return path


@pytest.fixture(scope="module")
def fitted(leaf_file):
    return phytofit.fit(leaf_file, "cm", method="paper", n_samples=40, n_points=300, n_generations=2)


@pytest.fixture(scope="module")
def segmented():
    points = np.random.default_rng(0).uniform(0.0, 20.0, (300, 3))
    place = {"collar": points[0], "tip": points[1], "midrib": points[:2]}
    leaf = SegmentedLeaf(
        1, 90.0, collar_distance=5.0, collar_height=4.0, length=30.0, n_points=50, flags=(HOSTILE,), **place
    )
    cloud = phytofit.from_points(points, "cm")
    return Segmentation(cloud, 1 + np.arange(300) % 2, points[:2], 1.0, np.array([0.0, 0.0, 1.0]), (leaf,))


@pytest.fixture(scope="module")
def results(fitted, segmented):
    """One of each kind."""
    turned, eye = np.zeros(300, np.int64), np.eye(4)[np.newaxis]
    nothing = {"turn": None, "step_deg": None, "loop": None, "contradicted": 0.0, "rejected": (), "settings": {}}
    camera = CAMERAS["kinect-v2"]
    made = Reconstruction(
        segmented.cloud, turned, turned + 1, camera, ("a.png",), eye, pairs=(), flags=(HOSTILE,), **nothing
    )
    run = PlantRun(trait_table("plant", fitted.traits), (segmented,), (Placed(remark("views", said=HOSTILE)),), (), ())
    return {"fit": fitted, "segmentation": segmented, "reconstruction": made, "run": run}


KINDS = ("fit", "segmentation", "reconstruction", "run")


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_shows_a_short_table(results, kind):
    shown = repr(results[kind])
    assert len(shown) < MOST_CHARACTERS
    assert "\x1b" not in shown
    made = results[kind].summary()
    lines = shown.splitlines()
    assert len(lines) == 2 + len(made.rows) + len(made.remarks)
    for line, row in zip(lines[2:], made.rows, strict=False):
        assert all(cell in line for cell in row)


def test_the_table_of_a_fit_holds_its_numbers(fitted):
    assert repr(fitted).startswith("Fit of leaf: sorghum phytomer, method paper\norgan")
    for trait in fitted.traits:
        assert f"{trait.name}" in repr(fitted)
        assert f"{trait.value:.2f}" in repr(fitted)


class Cells(HTMLParser):
    """The text in table cells and list items, and the tags seen."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.texts = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        assert not attrs
        self.tags.append(tag)

    def handle_data(self, data):
        self.texts.append(data)


@pytest.mark.parametrize("kind", KINDS)
def test_a_notebook_shows_the_same_and_runs_nothing(results, kind):
    found = Cells(results[kind]._repr_html_())
    assert set(found.tags) <= {"p", "table", "thead", "tbody", "tr", "th", "td", "ul", "li"}
    made = results[kind].summary()
    for cell in (cell for row in made.rows for cell in row if cell):
        assert cell in found.texts
    if kind != "fit":
        assert any("<b>[red]x[/]" in text for text in found.texts)


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_becomes_a_frame_and_a_picture(results, kind):
    table = results[kind].to_frame()
    assert len(table) == len(results[kind].summary().rows)
    if kind in ("fit", "run"):
        assert list(table.columns) == COLUMNS
    figure = results[kind].plot()
    assert figure.get_axes()


def test_a_frame_is_a_copy(results):
    table = results["run"].to_frame()
    table["value"] = 0.0
    assert (results["run"].table["value"] != 0.0).any()


def test_a_summary_without_rows_is_shown():
    class Empty(Shown):
        def summary(self):
            return Summary("nothing", ("a", "b"), [])

    assert repr(Empty()) == "nothing\na  b"


def test_a_file_is_taken_where_a_cloud_is(leaf_file, fitted):
    cloud = phytofit.read_cloud(leaf_file, "cm")
    same = phytofit.fit(cloud, method="paper", n_samples=40, n_points=300, n_generations=2)
    np.testing.assert_array_equal(same.x, fitted.x)
    assert fitted.name == same.name == "leaf"
    with pytest.raises(UnitError, match=r"leaf\.xyz"):
        phytofit.fit(str(leaf_file))
    with pytest.raises(SettingError, match="leave units out"):
        phytofit.segment(cloud, "mm")
    for function in (phytofit.segment, phytofit.separate_plants):
        with pytest.raises(phytofit.CloudError, match="no such file"):
            function("nowhere.ply", "cm")
