"""Agreement with hand measures: statistics against closed forms and SciPy, tables as people write them."""

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

LEAVES = ((1, 20.0), (2, 30.0), (3, 40.0))  # ranks, and lengths in cm
RESULT = "cloud,plant,organ,rank,trait,value,unit,low,high,method,flags\n"
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


@pytest.mark.parametrize(
    ("header", "row", "value"),
    [
        ("cloud,leaf_length_cm", "a,51.5", 51.5),
        ("Plant;Leaf length (mm)", "a;515", 51.5),
        ("ID\tLength [m]", "a\t0.515", 51.5),
        ('name,"Blade length, cm"', 'a,"51,5"', 51.5),
        ("\ufeffcloud,Leaf Length_CM,remarks", "a,51.5,bent", 51.5),
    ],
)
def test_columns_as_people_name_them(tmp_path, header, row, value):
    table = read_measures(written(tmp_path, f"{header}\n{row}\n"))
    assert table.to_dict("records") == [
        {"cloud": "a", "rank": "", "trait": "leaf_length", "value": pytest.approx(value), "unit": "cm"}
    ]


def test_every_trait_has_a_column(tmp_path):
    header = "cloud,stem diam mm,leaf_angle,leaf_width_cm,leaf insertion angle (rad),leaf area (mm2),stem_length_cm"
    table = read_measures(written(tmp_path, f"{header}\n1,32,68,6.3,1,12000,\n"))
    found = {row.trait: (row.value, row.unit) for row in table.itertuples()}
    assert found == {
        "stem_diameter": (pytest.approx(3.2), "cm"),
        "leaf_angle": (68.0, "deg"),
        "leaf_width": (6.3, "cm"),
        "leaf_insertion_angle": (pytest.approx(57.29578), "deg"),
        "leaf_area": (pytest.approx(120.0), "cm²"),
    }  # an empty cell is no measure


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "CSV"),
        ("cloud,leaf_length_cm\n", "no rows"),
        ("leaf_length_cm\n5\n", "names the cloud"),
        ("cloud,weight\na,3\n", "expected columns such as"),
        ("cloud,leaf_length\na,3\n", "has no unit"),
        ("cloud,leaf_length_cm\na,long\n", "expected a number, got 'long'"),
        ("cloud,trait,value,unit\na,leaf_length,3,furlong\n", "expected a unit"),
    ],
)
def test_what_is_no_table_of_measures_is_said(tmp_path, text, said):
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=said) as caught:
        read_measures(path)
    assert str(path) in str(caught.value)


def test_the_truth_of_simulated_phytomers_is_read(tmp_path):
    path = written(tmp_path, RESULT + "phytomer_0001,1,leaf,1,leaf_length,55.5,cm,,,truth,\n")
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
        f"c{i},1,leaf,1,leaf_length,{50 + i},cm,{48 + i},{'' if i == 2 else 52 + i},m,{'tip' if i == 2 else ''}\n"
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
    assert (table["trait"], table["n"], table["flagged"]) == ("leaf_length", 3, 1)
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
    written(tmp_path, RESULT + "b,1,leaf,1,leaf_length,3,cm,,,m,\n", "other.csv")
    done = CliRunner().invoke(
        app, ["validate", str(tmp_path / results), "--truth", str(hand), "--out", str(tmp_path / "v")]
    )
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())
    assert not (tmp_path / "v").exists()


def test_leaves_of_a_plant_are_told_apart_by_their_rank(tmp_path):
    results = pd.concat([results_of([("p", "leaf_length", v, v - 1.0, v + 1.0)]).assign(rank=i) for i, v in LEAVES])
    text = "plant,rank,leaf_length_cm\np,1,20.5\np,3,39.0\np,4,50\n"
    comparison = compare(read_measures(written(tmp_path, text)), results)
    assert comparison.pairs["value"].tolist() == [20.0, 40.0]
    assert comparison.pairs["cloud"].tolist() == ["p leaf 1", "p leaf 3"]
    assert "measured, no result: p leaf 4, leaf_length" in comparison.unmatched
    with pytest.raises(InputError, match="of 3 leaves; expected a column rank"):
        compare(read_measures(written(tmp_path, "plant,leaf_length_cm\np,20\n")), results)
