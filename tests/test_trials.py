"""How good it would be with a sensor: the same numbers as by hand, and answers that follow from them."""

from types import SimpleNamespace

import pandas as pd
import pytest
from typer.testing import CliRunner

import phytofit
from phytofit.cli import app
from phytofit.cli.validate import _tell
from phytofit.validation import PAIR_COLUMNS, Comparison, trials
from phytofit.validation.trials import MAIN_TRAITS, Trial, needed, share_within, trial, trial_table, vary

POSED = 1e-9  # a phytomer has the same traits in every pose, but for rounding
SENSOR = {"n_points": 400, "noise_cm": 0.2}


@pytest.fixture(scope="module")
def base():
    return trial(SENSOR, number=2, seed=4)


def made_up(offsets, n=None, trait="leaf_length", unit="cm"):
    """A trial of truths of 100 whose results are off by so much."""
    rows = [(f"p{i}", trait, unit, 100.0, 100.0 + off, 90.0, 110.0, "good", "", 1) for i, off in enumerate(offsets)]
    table = pd.DataFrame(rows, columns=PAIR_COLUMNS)
    return Trial(Comparison(table, ()), len(offsets) if n is None else n, {})


def test_pairs_are_the_truth_and_the_fit_of_the_same_cloud(base):
    pairs = base.comparison.pairs
    made = phytofit.simulate(seed=5, **SENSOR)
    result = phytofit.fit(made.points, "cm")
    mine = pairs[pairs["cloud"] == "phytomer_0002"]
    assert mine["measured"].tolist() == [t.value for t in phytofit.measure(made.organs)]
    assert mine["value"].tolist() == [t.value for t in result.traits]
    assert set(pairs["cloud"]) == {"phytomer_0001", "phytomer_0002"}


def test_the_same_phytomers_are_scanned_at_every_step_and_the_base_is_not_done_again(base, monkeypatch):
    """What the fit finds plays no part in it: here it is the same for every cloud."""
    called, clouds = [], []
    found = phytofit.measure(phytofit.simulate(seed=0, n_points=100).organs)

    def fitted(points, *_, **__):
        clouds.append(len(points))
        return SimpleNamespace(traits=found)

    monkeypatch.setattr(trials, "fit", fitted)
    made = vary(base, "n_points", (200, 400), seed=4, progress=lambda: called.append(1))
    assert made[400] is base
    assert len(called) == len(clouds) == base.n
    assert all(100 < n <= 200 for n in clouds)
    pairs, others = base.comparison.pairs, made[200].comparison.pairs
    assert others["cloud"].tolist() == pairs["cloud"].tolist()
    assert others["measured"].tolist() == pytest.approx(pairs["measured"].tolist(), rel=POSED)
    table = trial_table("points", made, 5.0, 3.0)
    assert table.groupby(["value", "trait"]).ngroups == len(table) == 2 * len(MAIN_TRAITS)


def test_lengths_count_by_per_cent_angles_by_degrees_and_refused_clouds_against():
    assert share_within(made_up([0.0, 4.9, -4.9, 5.1]), 5.0, 1.0)["leaf_length"] == pytest.approx(0.75)
    by_degrees = share_within(made_up([0.9, 1.1], trait="leaf_angle", unit="deg"), 50.0, 1.0)
    assert by_degrees["leaf_angle"] == pytest.approx(0.5)
    assert share_within(made_up([0.0], n=4), 5.0, 1.0)["leaf_length"] == pytest.approx(0.25)


def test_enough_is_from_where_on_nine_of_ten_are_near():
    good, bad = made_up([0.0] * 10), made_up([0.0] * 8 + [9.0, 9.0])
    assert needed({3: good, 1: bad, 2: good}, 5.0, 3.0)["leaf_length"] == (2, 1.0)
    assert needed({1: good, 2: bad, 3: good}, 5.0, 3.0)["leaf_length"] == (3, 1.0)
    assert needed({1: bad, 2: bad}, 5.0, 3.0)["leaf_length"] == (None, 0.8)


def test_where_few_phytomers_contradict_each_other_more_are_asked_for(tmp_path, capsys):
    """Near enough with 300 points and not with 1,000: chance, and no answer."""
    good, bad = made_up([0.0] * 10), made_up([0.0] * 8 + [9.0, 9.0])
    sensor = {**SENSOR, "noise_reach_cm": 0.0, "n_views": 3, "n_spheres": 0, "outlier_share": 0.0}
    base = Trial(good.comparison, good.n, sensor)
    _tell(base, {"points": {300: good, 1000: bad}, "cameras": {1: bad, 2: bad}}, 5.0, 3.0, tmp_path)
    said = " ".join(capsys.readouterr().out.split())
    assert "leaf length within 5 % of the truth in nine of ten: 10 phytomers can't tell; raise --number" in said
    assert "not with up to 2 cameras (at best in 80 %)" in said


def test_a_cloud_that_can_not_be_fitted_is_counted_and_named():
    made = trial({"n_points": 400, "n_spheres": 3, "sphere_diameter_cm": 40.0}, number=4, seed=1)
    assert made.comparison.unmatched
    assert all("remove all" in text or "points" in text for text in made.comparison.unmatched)
    assert len(made.comparison.unmatched) + made.comparison.pairs["cloud"].nunique() == 4
    none = Trial(Comparison(pd.DataFrame(columns=PAIR_COLUMNS), ("p0: no stem",)), 1, {})
    table = trial_table("points", {5: none}, 5.0, 3.0)
    assert table["refused"].tolist() == [1] * len(MAIN_TRAITS)
    assert table["within"].tolist() == [0.0] * len(MAIN_TRAITS)


def test_without_a_terminal_each_sensor_has_a_line(tmp_path, monkeypatch):
    found = phytofit.measure(phytofit.simulate(seed=0, n_points=100).organs)
    monkeypatch.setattr(trials, "fit", lambda *_, **__: SimpleNamespace(traits=found))
    monkeypatch.setattr(trials, "N_POINTS", (300, 500))
    monkeypatch.setattr(trials, "N_VIEWS", (1,))
    arguments = ["validate", "--simulate", "-n", "3", "--points", "300", "--out", str(tmp_path / "v")]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    lines = [line for line in done.stderr.splitlines() if "sensor" in line]
    assert lines == [f"simulated phytomers: sensor {i} of 3" for i in (1, 2, 3)]


@pytest.mark.long
def test_the_command_answers(tmp_path):
    arguments = ["validate", "--simulate", "-n", "3", "--points", "600", "--noise", "0.2", "--views", "2"]
    done = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "v")])
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    assert "600 points, 0.2 cm noise, 2 cameras" in said
    for trait in MAIN_TRAITS:
        assert said.count(f"{trait.replace('_', ' ')} within") == 2  # points and cameras
    needs = pd.read_csv(tmp_path / "v" / "needs.csv")
    assert set(needs[needs["setting"] == "points"]["value"]) == {300, 600, 1000, 2500, 5000}
    assert set(needs[needs["setting"] == "cameras"]["value"]) == {1, 2, 3, 6}
    page = (tmp_path / "v" / "validation.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 9
    assert "by hand" not in page


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "expected a folder of results with --truth"),
        (["results"], "expected a folder of results with --truth"),
        (["results", "--simulate"], "expected a folder of results with --truth"),
        (["--simulate", "--truth", "t.csv"], "expected a folder of results with --truth"),
        (["--simulate", "--noise", "-1"], "'--noise': expected 0 or more, got -1"),
        (["--simulate", "--views", "0"], "'--views': expected 1 to 1,000, got 0"),
        (["--simulate", "--species", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_the_command_says_what_is_wrong(tmp_path, arguments, said):
    done = CliRunner().invoke(app, ["validate", *arguments, "--out", str(tmp_path / "v")])
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())
    assert not (tmp_path / "v").exists()
