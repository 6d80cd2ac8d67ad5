"""Remarks and quality: one table of codes, which the docs show; each trait has what touches it, and no more."""

import dataclasses
import importlib.util
import json
import re
import string
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import phytofit
from phytofit.results import Placed, graded, grouped, remark
from phytofit.results.quality import LIMITS, of_intervals
from phytofit.results.remarks import KINDS, NOTE, in_short, of_codes, worst
from phytofit.traits import Trait

ALWAYS_WHOLE = ("not_fitted", "other_surfaces", "stem_ends_elsewhere", "views")  # said leaf by leaf, if they differ
DOCS = Path(__file__).parents[1] / "docs"
ORDER = ("poor", "check", "good", "")
TRAITS = {t.name for t in phytofit.measure(phytofit.simulate(seed=1).organs)}
OF_PLANTS = {"collar_height", "collar_distance", "divergence_angle", "leaf_azimuth"}


def fields_of(text):
    return {name for _, name, _, _ in string.Formatter().parse(text) if name}


def made(code, **values):
    return remark(code, **(dict.fromkeys(fields_of(KINDS[code].text), "x") | values))


@pytest.mark.parametrize("code", sorted(KINDS))
def test_a_kind_is_a_code_with_sentences_and_traits_that_there_are(code):
    kind = KINDS[code]
    assert re.fullmatch(r"[a-z]+(_[a-z]+)*", code)
    assert kind.grade in ("check", "poor", NOTE)
    assert set(kind.traits) <= TRAITS | OF_PLANTS
    assert not fields_of(kind.general)
    assert bool(kind.general) == bool(fields_of(kind.text)) or code in ALWAYS_WHOLE
    for sentence in (kind.text, kind.general, kind.remedy):
        assert not sentence.endswith((".", " "))
        assert "--" not in sentence  # of the library, which knows no options
    assert kind.when.endswith(".")
    assert str(made(code)).count("..") == 0


def test_the_page_in_the_docs_is_that_of_the_table():
    spec = importlib.util.spec_from_file_location("remarks_page", DOCS / "remarks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.PAGE.read_text(encoding="utf-8") == module.page(), "run python docs/remarks.py"
    assert [line for line in module.page().splitlines() if line.startswith("## ")][1:] == [f"## {c}" for c in KINDS]


UNITS = {t.name: t.unit for t in phytofit.measure(phytofit.simulate(seed=1).organs)}


def a_trait(half, name="leaf_length", value=50.0):
    return Trait("leaf", 1, name, value, UNITS[name], value - half, value + half)


def quality_of(trait, *remarks):
    (one,) = graded([trait], [*remarks, *of_intervals([trait])])
    return one.quality


@given(st.sampled_from(list(LIMITS)), st.floats(0.0, 300.0), st.floats(0.0, 300.0), st.floats(1.0, 200.0))
def test_a_wider_interval_is_never_of_better_quality(name, half, more, value):
    narrow, wide = (quality_of(a_trait(h, name, value)) for h in (half, half + more))
    assert ORDER.index(wide) <= ORDER.index(narrow)


@pytest.mark.parametrize("name", sorted(TRAITS))
def test_limits_are_as_their_table_says_and_do_not_ask_for_a_unit_of_length(name):
    value = 50.0
    scale = value if UNITS[name].startswith("cm") else 1.0
    check, poor = (limit * scale for limit in LIMITS[name])
    for half, quality in ((0.99 * check, "good"), (1.01 * check, "check"), (1.01 * poor, "poor")):
        trait = a_trait(half, name)
        assert quality_of(trait) == quality
        assert quality_of(dataclasses.replace(trait, unit=trait.unit.replace("cm", "rel"))) == quality
        small = a_trait(1e-3 * half if scale == value else half, name, 1e-3 * value)
        assert quality_of(small) == quality


def test_of_an_open_interval_the_closed_end_counts_and_without_one_nothing_is_good():
    trait = a_trait(1.0)
    assert quality_of(dataclasses.replace(trait, high=None)) == "good"
    assert quality_of(dataclasses.replace(trait, low=0.0, high=None)) == "poor"
    unknown = dataclasses.replace(trait, low=None, high=None)
    assert quality_of(unknown) == ""
    assert quality_of(unknown, remark("tip_unseen")) == "check"


@given(st.lists(st.sampled_from(list(KINDS)), max_size=6))
def test_a_trait_has_what_touches_it_and_the_worst_of_it(codes):
    remarks = [made(code) for code in codes]
    traits = [Trait("leaf", 1, name, 50.0, "deg", 49.0, 51.0) for name in sorted(TRAITS)]
    for trait in graded(traits, remarks):
        mine = [one for one in remarks if trait.name in one.traits]
        assert trait.flags == tuple(dict.fromkeys(one.code for one in mine))
        assert trait.quality == worst(["good", *(one.grade for one in mine)])


def test_a_remark_is_said_once_for_all_its_leaves_the_worst_first():
    few = [Placed(remark("leaf_few_points", n=str(n)), 0, rank) for rank, n in ((1, 20), (4, 30))]
    tips = [Placed(remark("tip_unseen"), plant, rank) for plant, rank in ((1, 2), (1, 3), (2, 1))]
    worst_one = Placed(remark("other_surfaces", share="20 %"))
    lines = grouped([*few, *tips, worst_one])
    assert [grade for grade, _ in lines] == ["poor", "check", "check"]
    assert lines[0][1] == (
        "20 % of the points lie on surfaces that are neither the fitted stem nor the fitted leaf. Cut the other leaves "
        "away (other_surfaces)"
    )
    assert lines[1][1].startswith("leaves 1, 4: few points on the leaf: ")
    assert lines[2][1].startswith("plant 1 leaves 2, 3; plant 2 leaf 1: the leaf's tip is missing")
    (alone,) = grouped(few[:1])
    assert alone[1].startswith("leaf 1: only 20 points on the leaf")
    reasons = [Placed(remark("not_fitted", reason=why), 0, rank) for rank, why in ((1, "no stem"), (2, "no leaf"))]
    assert [line for _, line in grouped(reasons)] == [
        f"leaf {rank}: not fitted: {why}. Look at its points in segmentation.png (not_fitted)"
        for rank, why in ((1, "no stem"), (2, "no leaf"))
    ]


def test_codes_of_another_version_stand_for_no_remark():
    assert of_codes(["rank_uncertain", "few points: this may not be a leaf"]) == (remark("rank_uncertain"),)
    assert in_short("rank_uncertain") == "rank uncertain"


@pytest.mark.parametrize("method", ["likelihood", "paper"])
def test_a_result_on_disk_says_its_remarks_in_full_and_each_trait_its_codes(tmp_path, method):
    scan = phytofit.simulate(n_points=1500, noise_cm=0.5, n_views=1, seed=11)
    cloud = phytofit.from_points(scan.points, "cm", name="leaf")
    quick = {"n_samples": 60, "n_generations": 3, "n_points": 800} if method == "paper" else {}
    result = phytofit.fit(cloud, method=method, up=-scan.pose[:3, 2], stem_above="equal", threads=1, **quick)
    assert isinstance(result, {"likelihood": phytofit.Fit, "paper": phytofit.PaperFit}[method])
    assert "up_doubtful" in result.flags
    said = json.loads((phytofit.save_fit(result, cloud, tmp_path) / "fit.json").read_text())
    assert [phytofit.Remark(**{**one, "traits": tuple(one["traits"])}) for one in said["remarks"]] == [*result.remarks]
    touching = {one["code"]: one["traits"] for one in said["remarks"]}
    for trait in said["traits"]:
        assert trait["flags"] == [code for code, traits in touching.items() if trait["trait"] in traits]
    table = result.to_frame()
    assert list(table["quality"]) == [trait["quality"] for trait in said["traits"]]
    assert list(table["flags"]) == [";".join(trait["flags"]) for trait in said["traits"]]
    assert ("good" in set(table["quality"])) == (method == "likelihood")
    assert np.isfinite(table["low"].to_numpy(float)).any() == (method == "likelihood")
