"""Agreement with hand measures: statistics against closed forms and SciPy, tables as people write them."""

import unicodedata
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from typer.testing import CliRunner

from phytofit.cli import app
from phytofit.errors import InputError
from phytofit.validation import agreement, compare, concordance, read_measures, read_results

AWKWARD = Path(__file__).parents[1] / "../shared/data/awkward"
LEAVES = ((1, 20.0), (2, 30.0), (3, 40.0))  # ranks, and lengths in cm
RESULT = "cloud,plant,organ,rank,trait,value,unit,low,high,quality,flags,method\n"
ROUNDING = 1e-9


def written(tmp_path, text, name="hand.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def results_of(rows):
    """A table of results: cloud, trait, value, low, high."""
    columns = ["cloud", "trait", "value", "low", "high"]
    table = pd.DataFrame(rows, columns=columns)
    return table.assign(unit=["deg" if "angle" in t else "cm" for t in table["trait"]], flags="")


def measures_of(rows):
    table = pd.DataFrame(rows, columns=["cloud", "trait", "value"])
    return table.assign(unit=["deg" if "angle" in t else "cm" for t in table["trait"]])


def test_the_truth_of_simulated_phytomers_is_read(tmp_path):
    path = written(tmp_path, RESULT + "phytomer_0001,1,leaf,1,leaf_length,55.5,cm,,,,,truth\n")
    assert read_measures(path)["value"].tolist() == [55.5]
    assert read_results(path)["value"].tolist() == [55.5]
    assert read_results(path)["low"].isna().all()


def test_clouds_are_found_by_alike_names_and_the_rest_is_listed():
    results = results_of([("0003", "leaf_length", 50.0, 49.0, 51.0), ("leaf_b", "leaf_length", 40.0, 39.0, 41.0)])
    measures = measures_of(
        [("3", "leaf_length", 52.0), ("Leaf_B.ply", "leaf_length", 40.5), ("gone", "leaf_length", 1.0)]
    )
    found = compare(measures, results)
    assert found.pairs["cloud"].tolist() == ["0003", "leaf_b"]
    assert found.unmatched == ("measured, no result: gone",)
    alone = compare(measures.iloc[:1], results)
    assert alone.unmatched == ("result, not measured: leaf_b",)


def test_names_that_fit_two_clouds_fit_none():
    results = results_of([("03", "leaf_length", 50.0, 49.0, 51.0), ("003", "leaf_length", 40.0, 39.0, 41.0)])
    assert compare(measures_of([("3", "leaf_length", 52.0)]), results).pairs.empty


@given(st.integers(0, 1000), st.integers(3, 30))
def test_statistics_are_those_of_the_textbook(seed, n):
    random = np.random.default_rng(seed)
    hand = random.normal(60.0, 10.0, n)
    value = 1.02 * hand + random.normal(0.5, 2.0, n)
    rows = [(f"c{i}", "leaf_length", v, v - 2.0, v + 2.0) for i, v in enumerate(value)]
    pairs = compare(measures_of([(f"c{i}", "leaf_length", h) for i, h in enumerate(hand)]), results_of(rows)).pairs
    (found,) = agreement(pairs)
    off = value - hand
    assert found.n == n
    assert found.bias == pytest.approx(off.mean(), rel=ROUNDING)
    assert found.rmse == pytest.approx(np.sqrt((off**2).mean()), rel=ROUNDING)
    assert found.r == pytest.approx(stats.pearsonr(hand, value).statistic, rel=ROUNDING)
    assert found.coverage == pytest.approx(np.mean(np.abs(off) <= 2.0))
    assert (found.upper - found.lower) / 2.0 == pytest.approx(1.96 * off.std(ddof=1), rel=ROUNDING)
    assert abs(found.ccc) <= abs(found.r) + ROUNDING


def test_concordance_falls_with_bias_and_scale_where_correlation_does_not():
    """Lin's definition: 1 - E (x - y)^2 / E (x - y)^2 if they were independent."""
    x = np.array([1.0, 2.0, 4.0, 7.0])
    assert concordance(x, x) == pytest.approx(1.0)
    assert concordance(x, -x + 7.0) == pytest.approx(-1.0)
    for y in (x + 1.0, 2.0 * x):
        independent = np.mean((x[:, np.newaxis] - y) ** 2)
        assert concordance(x, y) == pytest.approx(1.0 - np.mean((x - y) ** 2) / independent)
    assert np.isnan(concordance(x[:2], x[:2]))


def test_one_that_is_far_off_is_named_and_none_of_a_few():
    value = np.array([50.1, 49.8, 50.3, 49.9, 50.0, 58.0])
    rows = [(f"c{i}", "leaf_length", v, np.nan, np.nan) for i, v in enumerate(value)]
    hand = [(f"c{i}", "leaf_length", 50.0) for i in range(6)]
    (found,) = agreement(compare(measures_of(hand), results_of(rows)).pairs)
    assert found.outliers == ("c5",)
    assert np.isnan(found.coverage)
    assert found.n_intervals == 0
    (few,) = agreement(compare(measures_of(hand[2:]), results_of(rows[2:])).pairs)
    assert few.outliers == ()


def test_the_command_writes_one_page_and_two_tables(tmp_path):
    rows = "".join(
        f"c{i},1,leaf,1,leaf_length,{50 + i},cm,{48 + i},{',check,tip_unseen' if i == 2 else f'{52 + i},good,'},m\n"
        for i in range(4)
    )
    (tmp_path / "results").mkdir()
    written(tmp_path, RESULT + rows, "results/traits.csv")
    hand = written(tmp_path, "cloud,leaf_length_mm,leaf_width_mm\nc0,505,60\nc1,512,\nc2,600,\nc9,1,\n")
    done = CliRunner().invoke(
        app, ["validate", str(tmp_path / "results"), "--truth", str(hand), "--out", str(tmp_path / "v")]
    )
    assert done.exit_code == 0, done.output
    assert "measured, no result: c0, leaf_width" in done.output
    assert "result, not measured: c3" in done.output
    table = pd.read_csv(tmp_path / "v" / "validation.csv").iloc[0]
    assert tuple(table[["trait", "n", "good", "check", "poor"]]) == ("leaf_length", 3, 2, 1, 0)
    assert table["bias"] == pytest.approx((-0.5 - 0.2 - 8.0) / 3, abs=1e-5)
    assert table["coverage"] == pytest.approx(1.0)  # open above where the tip was not seen
    assert len(pd.read_csv(tmp_path / "v" / "pairs.csv")) == 3
    page = (tmp_path / "v" / "validation.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 1
    assert "http" not in page.replace("http-equiv", "")
    assert "c9" in page


@pytest.mark.parametrize(
    ("results", "said"),
    [
        ("nowhere", "expected a folder of results"),
        ("hand.csv", "low, high, flags are missing"),
        ("other.csv", "none of"),
    ],
)
def test_the_command_says_what_is_wrong(tmp_path, results, said):
    hand = written(tmp_path, "cloud,trait,value,unit\na,leaf_length,3,cm\n")
    written(tmp_path, RESULT + "b,1,leaf,1,leaf_length,3,cm,,,,,m\n", "other.csv")
    done = CliRunner().invoke(
        app, ["validate", str(tmp_path / results), "--truth", str(hand), "--out", str(tmp_path / "v")]
    )
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())
    assert not (tmp_path / "v").exists()


def measured(tmp_path, text, results):
    return compare(read_measures(written(tmp_path, text)), results)


def test_leaves_of_a_plant_are_found_by_their_rank(tmp_path):
    results = pd.concat([results_of([("p", "leaf_length", v, v - 1.0, v + 1.0)]).assign(rank=i) for i, v in LEAVES])
    text = "plant,rank,leaf_length_cm\np,1,20.5\np,3,39.0\np,4,50\n"
    comparison = measured(tmp_path, text, results)
    assert comparison.pairs["value"].tolist() == [20.0, 40.0]
    assert comparison.pairs["cloud"].tolist() == ["p leaf 1", "p leaf 3"]
    assert "measured, no result: p leaf 4, leaf_length" in comparison.unmatched
    with pytest.raises(InputError, match="of 3 leaves; expected a column rank"):
        measured(tmp_path, "plant,leaf_length_cm\np,20\n", results)


def test_a_trait_of_the_stem_is_found_beside_any_leaf(tmp_path):
    results = results_of([("p", "stem_diameter", 3.0, 2.0, 4.0), ("p", "leaf_length", 30.0, 29.0, 31.0)])
    results["rank"] = [0, 1]
    pairs = measured(tmp_path, "plant,leaf,leaf_length_cm,stem_diameter_cm\np,1,31,3.5\n", results).pairs
    assert pairs["cloud"].tolist() == ["p leaf 1", "p"]
    assert pairs["measured"].tolist() == [31.0, 3.5]


def test_plants_of_a_cloud_are_found_by_their_number(tmp_path):
    results = pd.concat([results_of([("s", "leaf_length", v, np.nan, np.nan)]).assign(plant=i) for i, v in LEAVES])
    pairs = measured(tmp_path, "cloud,plant,leaf_length_cm\ns,3,41\ns,1,21\n", results).pairs
    assert pairs["cloud"].tolist() == ["s plant 3", "s plant 1"]
    assert pairs["value"].tolist() == [40.0, 20.0]
    with pytest.raises(InputError, match="of 3 plants; expected a column plant"):
        measured(tmp_path, "cloud,leaf_length_cm\ns,20\n", results)
    old = results[results["plant"] == 1].drop(columns="plant")  # a table of an earlier version
    assert measured(tmp_path, "cloud,plant,leaf_length_cm\ns,1,21\n", old).pairs["value"].tolist() == [20.0]


def test_a_result_given_twice_is_refused(tmp_path):
    results = results_of([("p", "leaf_length", 30.0, 29.0, 31.0)] * 2)
    with pytest.raises(InputError, match="leaf_length in 2 rows"):
        measured(tmp_path, "plant,leaf_length_cm\np,20\n", results)


@pytest.mark.parametrize(
    "text",
    [
        "cloud,leaf_length_cm\na,48\na,50\nb,72\n",
        "cloud,leaf_length_cm,leaf length 2 (mm)\na,48,500\nb,72,NA\n",
        "cloud,observer,leaf_length_cm\na,1,48\nb,1,72\nA.ply,2,50\n",
    ],
)
def test_measures_of_several_observers_are_averaged_and_said(tmp_path, text):
    results = results_of([("a", "leaf_length", 47.0, 46.0, 48.0), ("b", "leaf_length", 70.0, 69.0, 71.0)])
    comparison = measured(tmp_path, text, results)
    assert comparison.pairs["measured"].tolist() == [49.0, 72.0]
    assert comparison.pairs["n_measured"].tolist() == [2, 1]
    assert agreement(comparison.pairs)[0].n == 2
    assert comparison.notes == ("leaf_length was measured more than once, and the mean is used: a (48, 50 cm)",)


def test_how_far_many_repeats_differ_is_said(tmp_path):
    """Of two normal values each: the standard deviation of one, pooled, is that of their differences over root two."""
    random = np.random.default_rng(0)
    first, second = random.normal(50.0, 2.0, (2, 8)).round(2)
    results = results_of([(f"c{i}", "leaf_length", 50.0, 49.0, 51.0) for i in range(8)])
    rows = "".join(f"c{i},{a},{b}\n" for i, (a, b) in enumerate(zip(first, second, strict=True)))
    (note,) = measured(tmp_path, "cloud,length (cm) A,length (cm) B\n" + rows, results).notes
    assert "in 8 of 8" in note
    assert f"{np.sqrt(np.mean((first - second) ** 2) / 2.0):.2g} cm" in note
    assert f"c{np.argmax(np.abs(first - second))} (" in note


@pytest.mark.parametrize(
    ("hand", "result"),
    [
        (unicodedata.normalize("NFD", "Prüfglied_3"), unicodedata.normalize("NFC", "Prüfglied_3")),
        (unicodedata.normalize("NFC", "Prüfglied_3"), unicodedata.normalize("NFD", "Prüfglied_3")),
        ("=1+1", "'=1+1"),
        ("'-14", "'-14"),
        ("scans/0003.ply", "0003"),
        ("C:\\scans\\Leaf B.LAZ", "leaf_b"),
        ("a/x.ply", "a_x"),
        ("plant 7", "Plant_007"),
        ("3.0", "0003"),
    ],
)
def test_a_cloud_is_found_by_a_name_that_is_written_otherwise(hand, result):
    results = results_of([(result, "leaf_length", 50.0, 49.0, 51.0), ("other", "leaf_length", 1.0, 0.0, 2.0)])
    assert compare(measures_of([(hand, "leaf_length", 52.0)]), results).pairs["cloud"].tolist() == [result]


@pytest.mark.skipif(not AWKWARD.is_dir(), reason="no data")
def test_a_decomposed_name_is_one_plant():
    folder = AWKWARD / "24_truth_nfd_name"
    pairs = compare(read_measures(folder / "truth.csv"), read_results(folder / "traits.csv")).pairs
    assert len(pairs) == 4
    assert {unicodedata.normalize("NFC", name) for name in pairs["cloud"]} == {"Prüfglied_3", "0007"}
    for name in ("truth", "truth_three_observers"):
        measures = read_measures(AWKWARD / f"26_truth_duplicated_id/{name}.csv")
        results = results_of([("0003", "leaf_length", 47.5, 47.0, 48.0), ("0007", "leaf_length", 72.0, 71.0, 73.0)])
        found = compare(measures, results)
        assert len(found.pairs) == 2
        assert len(found.notes) == 1
