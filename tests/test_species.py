"""Species files: what ships loads, the order in the file does not matter, every mistake is named."""

import re
import tomllib
from importlib import resources

import numpy as np
import pytest

from phytofit.bundled import species_names
from phytofit.errors import InputError, SpeciesError
from phytofit.models import Phytomer
from phytofit.species import load_species

SORGHUM = (resources.files("phytofit") / "species" / "sorghum.toml").read_text(encoding="utf-8")
SORGHUM = re.sub(r"discrepancy = .*\n", "", SORGHUM)


@pytest.fixture
def written(tmp_path):
    """Writes sorghum's file with some text replaced, and returns its path."""

    def write(*replacements):
        text = SORGHUM
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize("name", species_names())
def test_shipped_species_load(name):
    species = load_species(name)
    assert species.name == name
    assert isinstance(species.model, Phytomer)
    assert species.space.names == Phytomer.PARAMETERS[: len(species.space)]
    assert species.space.units == Phytomer.UNITS[: len(species.space)]
    assert species.ranges.shape == (len(species.space), 2)
    assert np.all(species.ranges[:, 0] <= species.ranges[:, 1])
    assert np.all(species.space.lower <= species.ranges[:, 0])
    assert np.all(species.ranges[:, 1] <= species.space.upper)
    stem, leaf = species.model.organs(species.space.mean)
    assert stem.area[0] > 0
    assert leaf.area[0] > 0


def test_sorghum_is_the_default_and_draws_the_ranges_of_section_v():
    species = load_species()
    assert "sorghum" in species_names()
    assert species.name == "sorghum"
    np.testing.assert_array_equal(
        species.ranges[:6], [[2, 5], [10, 20], [30, 60], [40, 70], [4, 8], [3, 4]], "section V of the paper"
    )
    file = tomllib.loads(SORGHUM)["parameters"]
    np.testing.assert_array_equal(species.space.mean, [file[n]["mean"] for n in species.space.names])
    np.testing.assert_array_equal(species.space.std, [file[n]["std"] for n in species.space.names])


def blocks():
    """The file's head, and its [parameters.*] tables in order."""
    head, *tables = SORGHUM.split("[parameters.")
    return head, ["[parameters." + table for table in tables]


def test_parameters_come_in_the_models_order_whatever_the_files(tmp_path):
    head, tables = blocks()
    path, straight = tmp_path / "reversed.toml", tmp_path / "straight.toml"
    path.write_text(head + "\n".join(reversed(tables)), encoding="utf-8")
    straight.write_text(SORGHUM, encoding="utf-8")
    mine, shipped = load_species(path), load_species(straight)
    assert mine.space == shipped.space
    assert mine.model == shipped.model
    np.testing.assert_array_equal(mine.ranges, shipped.ranges)


def test_the_last_parameter_and_the_constants_are_optional(tmp_path):
    _, tables = blocks()
    path = tmp_path / "six.toml"
    path.write_text('name = "six"\nmodel = "phytomer"\n' + "\n".join(tables[:6]), encoding="utf-8")
    species = load_species(path)
    assert species.space.names == Phytomer.PARAMETERS[:6]
    assert species.model == Phytomer()
    species.model.organs(species.space.mean)


def test_constants_reach_the_model(written):
    path = written(
        ("n_pieces = 30 ", "n_pieces = 12 "),
        ("widest_share = 0.5", "widest_share = 0.25"),
        ("slow_share = 0.2", "slow_share = 0.5"),
        ("concavity = 2.0", "concavity = 3.0"),
    )
    assert load_species(path).model == Phytomer(12, 0.25, 0.5, 3.0)


def test_bounds_that_are_left_out_are_infinite():
    space = load_species("sorghum").space
    i = space.index("leaf_rotate_angle")
    assert (space.lower[i], space.upper[i]) == (-np.inf, np.inf)
    assert space.lower[space.index("stem_diameter")] > 0


WIDTH = '[parameters.leaf_width]\nunit = "cm"\nmean = 6.0\nstd = 2.0\nlower = 0.3\nrange = [4.0, 8.0]'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "sorghum"', "", r"name: Field required"),
        ('name = "sorghum"', 'name = ""', r"name: .*at least 1 character.*got ''"),
        ('model = "phytomer"', 'model = "tree"', r"model: .*'phytomer'.*got 'tree'"),
        ('model = "phytomer"', 'model = "phytomer"\ncolour = 3', r"colour: Extra inputs are not permitted \(got 3\)"),
        ("n_pieces = 30 ", "n_pieces = 1 ", r"constants\.n_pieces: .*greater than or equal to 2 \(got 1\)"),
        ("n_pieces = 30 ", "n_pieces = 30.5 ", r"constants\.n_pieces: .*integer.*got 30\.5"),
        ("n_pieces = 30 ", "pieces = 30 ", r"constants\.pieces: Extra inputs"),
        ("widest_share = 0.5", "widest_share = 1.0", r"constants\.widest_share: .*less than 1"),
        ("slow_share = 0.2", "slow_share = -0.2", r"constants\.slow_share: .*greater than or equal to 0"),
        ("concavity = 2.0", "concavity = 3.5", r"constants\.concavity: .*less than or equal to 3 \(got 3\.5\)"),
        ("concavity = 2.0", "concavity = nan", r"constants\.concavity: "),
        (WIDTH, "", r"parameters: no leaf_width; the phytomer has stem_diameter, .*, stem_length_above"),
        (WIDTH, WIDTH.replace("leaf_width", "leaf_with"), r"parameters: unknown leaf_with; the phytomer has"),
        (WIDTH, WIDTH.replace('unit = "cm"\n', ""), r"parameters\.leaf_width\.unit: Field required"),
        (WIDTH, WIDTH.replace('"cm"', '"mm"'), r"parameters\.leaf_width\.unit: expected 'cm', got 'mm'"),
        (WIDTH, WIDTH.replace("mean = 6.0\n", ""), r"parameters\.leaf_width\.mean: Field required"),
        (WIDTH, WIDTH.replace("mean = 6.0", 'mean = "wide"'), r"parameters\.leaf_width\.mean: .*number.*got 'wide'"),
        (WIDTH, WIDTH.replace("mean = 6.0", "mean = inf"), r"parameters\.leaf_width\.mean: .*finite.*got inf"),
        (WIDTH, WIDTH.replace("std = 2.0", "std = 0.0"), r"parameters\.leaf_width\.std: .*greater than 0"),
        (WIDTH, WIDTH.replace("std = 2.0", "std = nan"), r"parameters\.leaf_width\.std: "),
        (WIDTH, WIDTH.replace("lower = 0.3", "lowest = 0.3"), r"parameters\.leaf_width\.lowest: Extra inputs"),
        (WIDTH, WIDTH.replace("lower = 0.3", "lower = -inf"), r"parameters\.leaf_width\.lower: .*finite"),
        (
            WIDTH,
            WIDTH.replace("lower = 0.3", "lower = 7.0").replace("[4.0, 8.0]", "[7.0, 8.0]"),
            r"parameter leaf_width: expected lower <= mean <= upper and lower < upper, got 7 <= 6 <= inf",
        ),
        (
            WIDTH,
            WIDTH.replace("[4.0, 8.0]", "[8.0, 4.0]"),
            r"parameters\.leaf_width\.range: expected two ascending numbers .* got \[8\.0, 4\.0\]",
        ),
        (
            WIDTH,
            WIDTH.replace("[4.0, 8.0]", "[0.1, 4.0]"),
            r"parameters\.leaf_width\.range: .*within the bounds \[0\.3, inf\], got \[0\.1, 4\.0\]",
        ),
        (WIDTH, WIDTH.replace("[4.0, 8.0]", "[4.0]"), r"parameters\.leaf_width\.range"),
        (WIDTH, WIDTH.replace("[4.0, 8.0]", "[4.0, 6.0, 8.0]"), r"parameters\.leaf_width\.range"),
        (WIDTH, WIDTH.replace("range = [4.0, 8.0]", ""), r"parameters\.leaf_width\.range: Field required"),
        (WIDTH, WIDTH + "\n" + WIDTH, r"not a TOML file \("),
        (WIDTH, "leaf_width = = 3", r"not a TOML file \("),
    ],
)
def test_mistakes_name_the_file_the_key_and_what_was_expected(written, old, new, message):
    path = written((old, new))
    with pytest.raises(SpeciesError, match=message) as caught:
        load_species(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert isinstance(caught.value, InputError)


def test_a_parameter_fixed_by_its_bounds_is_refused(written):
    fixed = WIDTH.replace("lower = 0.3", "lower = 6.0\nupper = 6.0").replace("[4.0, 8.0]", "[6.0, 6.0]")
    with pytest.raises(SpeciesError, match=r"parameter leaf_width: expected lower <= mean <= upper"):
        load_species(written((WIDTH, fixed)))


def test_no_parameters_at_all(tmp_path):
    path = tmp_path / "bare.toml"
    path.write_text('name = "bare"\nmodel = "phytomer"\n', encoding="utf-8")
    with pytest.raises(SpeciesError, match=r"parameters: Field required"):
        load_species(path)


def test_an_empty_file(tmp_path):
    path = tmp_path / "empty.toml"
    path.touch()
    with pytest.raises(SpeciesError, match=r"empty\.toml: name: Field required"):
        load_species(path)


def test_an_unknown_name_lists_the_species():
    with pytest.raises(SpeciesError, match=r"barley: can't be read \(No such file.*\).*sorghum"):
        load_species("barley")


def test_what_is_no_text_file(tmp_path):
    (tmp_path / "plant.toml").write_bytes(b"name = \xff\xfe")
    with pytest.raises(SpeciesError, match=r"plant\.toml: not UTF-8 text"):
        load_species(tmp_path / "plant.toml")
    with pytest.raises(SpeciesError, match=r"can't be read \(Is a directory\)"):
        load_species(tmp_path)


@pytest.mark.parametrize("value", ["-0.1", "inf", '"much"'])
def test_a_discrepancy_is_read_or_refused_by_name(written, value):
    given = "range = [4.0, 8.0]\n"
    assert load_species(written((given, given + "discrepancy = 0.1\n"))).space.parameters[4].discrepancy == 0.1
    with pytest.raises(SpeciesError, match=r"leaf_width\.discrepancy"):
        load_species(written((given, given + f"discrepancy = {value}\n")))
