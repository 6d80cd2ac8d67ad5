"""How the stem goes on above the leaf: as long as below it (the paper's six parameters), not at all, or freely."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import phytofit
import phytofit.models
from phytofit import SettingError
from phytofit.cli import app
from phytofit.models import Phytomer

SMALL = {"method": "paper", "n_samples": 120, "n_points": 800, "n_generations": 5, "threads": 2}
GENTLE = {"leaf_length": 55.0, "leaf_angle": 50.0, "leaf_width": 6.0, "stem_diameter": 3.0, "stem_length": 12.0}
DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "sodhi2018"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data/sodhi2018 is absent")
SIX = st.tuples(*(st.floats(*ends) for ends in ((1, 5), (5, 20), (5, 175), (20, 80), (2, 9), (-3, 6))))


@pytest.fixture(scope="module")
def made():
    return phytofit.simulate(fixed=GENTLE, stem_above="equal", noise_cm=0.2, seed=3)


@pytest.fixture(scope="module")
def result(made):
    return phytofit.fit(made.points, "cm", **SMALL)


def values(organs):
    return {t.name: t.value for t in phytofit.measure(organs)}


@given(SIX, st.sampled_from([0.0, 1.0]))
def test_six_parameters_are_seven_of_which_the_last_follows_from_the_second(x, share):
    both = zip(Phytomer(stem_above=share).organs(x), Phytomer(stem_above=0.3).organs([*x, share * x[1]]), strict=True)
    for six, seven in both:
        np.testing.assert_array_equal(six.axis, seven.axis)
        np.testing.assert_array_equal(six.half_width, seven.half_width)


@given(SIX)
def test_a_leaf_in_the_middle_of_its_stem_is_the_same_upside_down(x):
    model = Phytomer(stem_above=1.0)
    turn, offset, pose = model.upside_down(np.array(x))
    twin = turn @ x + offset
    there = phytofit.models.move([organ.row(0) for organ in model.organs(twin)], pose)
    stem, leaf = (organ.row(0) for organ in model.organs(x))
    np.testing.assert_allclose(there[0].axis[::-1], stem.axis, atol=1e-9)
    np.testing.assert_allclose(there[1].axis, leaf.axis, atol=1e-9)
    assert twin[2] == pytest.approx(180.0 - x[2])
    again, back, _ = model.upside_down(twin)
    np.testing.assert_allclose(again @ twin + back, x, atol=1e-9)


def test_a_leaf_at_the_top_of_its_stem_has_no_twin_upside_down():
    assert Phytomer().upside_down(np.array([3.0, 15.0, 45.0, 50.0, 6.0, 3.0])) is None


def test_the_papers_method_has_six_parameters_and_the_leaf_in_the_middle(made, result):
    assert tuple(result.parameters) == Phytomer.PARAMETERS[:6]
    assert result.settings["stem_above"] == "equal"
    found, true = values(result.organs), values(made.organs)
    assert found["stem_length"] == pytest.approx(2.0 * result.parameters["stem_length"])
    assert found["stem_length"] == pytest.approx(true["stem_length"], abs=3.0)
    assert found["leaf_length"] == pytest.approx(true["leaf_length"], abs=4.0)
    assert found["leaf_angle"] == pytest.approx(true["leaf_angle"], abs=10.0)
    assert result.pose[:3, 2] @ made.pose[:3, 2] > 0.98
    assert result.flags == ()


@pytest.mark.parametrize("method", ["paper", "likelihood"])
def test_stated_up_decides_between_the_twins(made, method):
    settings = SMALL if method == "paper" else {"stem_above": "equal", "threads": 2}
    over = phytofit.fit(made.points, "cm", up=-made.pose[:3, 2], **settings)
    assert len(over.x) == 6
    assert over.pose[:3, 2] @ made.pose[:3, 2] < -0.98
    assert over.parameters["leaf_angle"] == pytest.approx(130.0, abs=10.0)
    assert values(over.organs)["leaf_length"] == pytest.approx(values(made.organs)["leaf_length"], abs=6.0)
    assert "up_doubtful" in over.flags


@pytest.mark.parametrize(
    ("ends", "how", "said"),
    [
        ((6.0, 22.0), "equal", "stem_above='free' may fit better than 'equal'"),
        ((12.0, 12.0), "none", "stem_above='equal' may fit better than 'none'"),
        ((6.0, 22.0), "free", None),
        ((16.0, 0.0), "none", None),
    ],
)
def test_a_stem_that_ends_elsewhere_than_it_may_is_flagged(ends, how, said):
    fixed = GENTLE | {"stem_length": ends[0], "stem_length_above": ends[1]}
    made = phytofit.simulate(fixed=fixed, noise_cm=0.2, n_points=2000, seed=4)
    fast = SMALL | {"n_samples": 40, "n_points": 300, "n_generations": 2}
    remarks = phytofit.fit(made.points, "cm", up=made.pose[:3, 2], stem_above=how, **fast).remarks
    mine = [one.text for one in remarks if one.code == "stem_ends_elsewhere"]
    assert len(mine) == (said is not None)
    if said:
        assert said in mine[0]
        above, below = (float(word) for word in mine[0].split() if word[0].isdigit())
        assert (below, above) == pytest.approx(ends, abs=2.5)


def test_a_simulation_draws_the_stem_as_asked():
    free, equal, none = (phytofit.simulate(stem_above=how, seed=5) for how in ("free", "equal", "none"))
    place = phytofit.load_species().space.index("stem_length_above")
    np.testing.assert_array_equal(np.delete(equal.x, place), np.delete(free.x, place))
    assert equal.x[place] == equal.x[1]
    assert none.x[place] == 0.0
    assert values(equal.organs)["stem_length"] == pytest.approx(2.0 * equal.x[1])
    assert values(none.organs)["stem_length"] == pytest.approx(equal.x[1])
    with pytest.raises(SettingError, match="stem_length_above: expected no value"):
        phytofit.simulate(stem_above="equal", fixed={"stem_length_above": 3.0})


def test_anything_else_is_refused(made):
    for call in (phytofit.simulate, lambda **how: phytofit.fit(made.points, "cm", **how)):
        with pytest.raises(SettingError, match="stem_above: expected one of equal, none, free, got 'half'"):
            call(stem_above="half")


def test_the_command_hands_it_on(tmp_path):
    run = CliRunner().invoke
    made = run(app, ["simulate", "--stem-above", "equal", "--points", "1500", "--out", str(tmp_path / "made")])
    assert made.exit_code == 0, made.output
    cloud = tmp_path / "made" / "phytomer_0001.ply"
    fast = ["--method", "paper", "--samples", "20", "--points", "200", "--generations", "1"]
    for given_, how, n in (([], "equal", 6), (["--stem-above", "free"], "free", 7)):
        done = run(app, ["fit", str(cloud), "--units", "cm", *fast, *given_, "--out", str(tmp_path / how)])
        assert done.exit_code == 0, done.output
        stored = json.loads((tmp_path / how / "phytomer_0001" / "fit.json").read_text())
        assert len(stored["parameters"]) == n
        assert stored["settings"]["fit"]["stem_above"] == how


@needs_data
@pytest.mark.parametrize("number", ["0000", "0001"])
def test_the_authors_own_clouds_are_measured(number):
    """Their leaf joins in the middle of a stem twice as long as their stem_internode_len."""
    cloud = phytofit.read_cloud(next((DATA / "simulated").glob(f"noise_none*/{number}.ply")), "cm")
    theirs = dict(line.split() for line in Path(cloud.source).with_suffix(".txt").read_text().splitlines())
    found = phytofit.fit(cloud, **SMALL | {"n_samples": 200, "n_generations": 6}).parameters
    assert found["stem_length"] == pytest.approx(float(theirs["stem_internode_len"]), abs=1.5)
    assert found["leaf_length"] == pytest.approx(float(theirs["leaf_length"]), abs=4.0)
    assert found["leaf_angle"] == pytest.approx(float(theirs["leaf_angle"]), abs=8.0)
