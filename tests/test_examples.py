"""The examples run as they stand, with warnings as errors, and what they print makes sense."""

import json
import re
import runpy
import sys
import tempfile
from pathlib import Path

import pytest

import phytofit
import phytofit.models

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NEAR = 0.35  # share; of a leaf's length after three generations of 60 candidates
NUMBER = r"(-?\d+\.\d+)"


@pytest.fixture
def run(capfd, monkeypatch, tmp_path):
    """Runs an example as `python` would, in `tmp_path`, and returns what it prints; warnings are errors here too."""

    def run(number, *arguments):
        (script,) = (path for path in EXAMPLES if path.name.startswith(f"{number:02}_"))
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        monkeypatch.setattr(sys, "argv", [str(script), "--quick", *map(str, arguments)])
        capfd.readouterr()
        runpy.run_path(str(script), run_name="__main__")
        printed, complaints = capfd.readouterr()
        assert not complaints
        return printed

    return run


def beside_truth(printed):
    """{name: (estimate, truth)} of the lines that show both."""
    lines = re.findall(rf"^ *(\w+) +{NUMBER}.*true {NUMBER}$", printed, re.MULTILINE)
    return {name: (float(estimate), float(truth)) for name, estimate, truth in lines}


def assert_near(printed, *names):
    found = beside_truth(printed)
    for name in names:
        estimate, truth = found[name]
        assert estimate == pytest.approx(truth, rel=NEAR), name


def test_every_example_is_tested():
    tests = Path(__file__).read_text(encoding="utf-8")
    for number, path in enumerate(EXAMPLES, start=1):
        assert path.name.startswith(f"{number:02}_")
        assert f"run({number}" in tests


def test_fit_a_cloud(run, tmp_path):
    printed = run(1, "--out", tmp_path / "results")
    assert "status: converged" in printed
    assert_near(printed, "leaf_length", "stem_length", "stem_diameter")
    stored = json.loads((tmp_path / "results" / "simulated" / "fit.json").read_text(encoding="utf-8"))
    (length,) = (trait["value"] for trait in stored["traits"] if trait["trait"] == "leaf_length")
    assert beside_truth(printed)["leaf_length"][0] == pytest.approx(length, abs=0.005)
    assert (tmp_path / "results" / "simulated" / "fit.png").stat().st_size > 0


def test_fit_a_cloud_of_ones_own(run, tmp_path):
    cloud = phytofit.from_points(10 * phytofit.simulate(seed=1).points, "mm")
    phytofit.write_cloud(tmp_path / "mine.ply", cloud)
    printed = run(1, "mine.ply", "--units", "mm")
    assert "true" not in printed
    assert re.search(rf"^leaf_length +{NUMBER} cm", printed, re.MULTILINE)
    (picture,) = re.findall(r"The model on the points: (.*)", printed)
    assert Path(picture).is_relative_to(tmp_path)
    assert Path(picture).is_file()


def test_parts(run):
    printed = run(2)
    levels = [float(level) for level in re.findall(rf"generation \d: .*elite within {NUMBER} cm", printed)]
    assert len(levels) == 3
    assert levels[-1] < levels[0]
    assert_near(printed, "leaf_length", "stem_length", "stem_diameter")


def test_own_distance(run):
    printed = run(3)
    parts = re.split(rf"^(\w+) distance {NUMBER} cm$", printed, flags=re.MULTILINE)[1:]
    (paper, paper_error, of_paper), (own, own_error, of_own) = parts[:3], parts[3:]
    assert (paper, own) == ("hausdorff", "truncated")
    assert float(own_error) < 2.0 < float(paper_error)  # no point counts for more than 2 cm; one outlier is further off
    (by_paper, truth), (by_own, _) = (beside_truth(text)["leaf_length"] for text in (of_paper, of_own))
    assert abs(by_own - truth) < abs(by_paper - truth)


def test_own_species(run, tmp_path):
    printed = run(4, "--out", tmp_path / "species")
    species = phytofit.load_species(tmp_path / "species" / "small-grass.toml")
    found = beside_truth(printed)
    assert tuple(found) == species.space.names
    for (_, truth), (low, high) in zip(found.values(), species.ranges, strict=True):
        assert low <= truth <= high
    assert_near(printed, "leaf_length", "stem_diameter")


def test_own_optimiser(run):
    printed = run(5)
    first, best = re.search(rf"generation 1: {NUMBER} cm; best of all 8: {NUMBER} cm", printed).groups()
    assert float(best) < float(first)
    assert tuple(beside_truth(printed)) == phytofit.load_species().space.names[:7]
    assert_near(printed, "leaf_length", "stem_length")


def test_the_species_of_the_documentation_is_one(tmp_path):
    text = (ROOT / "docs" / "add-a-species.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```toml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    (whole,) = (block for block in blocks if "model =" in block)
    (tmp_path / "maize.toml").write_text(whole, encoding="utf-8")
    species = phytofit.load_species(tmp_path / "maize.toml")
    assert species.name == "maize"
    assert species.space.names == phytofit.models.Phytomer.PARAMETERS[:7]
    assert len(phytofit.simulate(species).points) == 5000
