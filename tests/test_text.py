"""Text from outside, where it is shown and stored: harmless, and still to be recognised."""

import csv
import io
import string

import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from rich.console import Console

from phytofit.text import for_file_name, for_picture, for_table, for_terminal, one_line

HOSTILE = ["[/]", "[red]x", "a\x1b[31mred", "a\nb", "$x$", "$\\frac$", "=cmd|' /C calc'!A0", "-x", "..", ".", "", " ",
           "a/b", "a\\b", "\udcff.ply", "\u202egnp.x", "\\[", "x\\"]  # fmt: skip


def printed(text):
    with io.StringIO() as file:
        Console(file=file, width=500, soft_wrap=True, force_terminal=False).print(text, highlight=False)
        return file.getvalue()


@pytest.mark.parametrize("name", HOSTILE)
def test_a_terminal_shows_the_line_as_it_is(name):
    assert printed(for_terminal(name)).replace("\\", "") == one_line(name).replace("\\", "") + "\n"


@given(st.text())
def test_a_line_is_one_visible_line(text):
    line = one_line(text)
    assert line.isprintable()
    line.encode("utf-8")
    if text.isprintable() and text == " ".join(text.split()):
        assert line == text


@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.parametrize("name", HOSTILE)
def test_a_picture_draws_it(name):
    figure = Figure()
    figure.suptitle(for_picture(name))
    with io.BytesIO() as file:
        figure.savefig(file)


@given(st.text())
def test_a_spreadsheet_finds_no_formula(text):
    assert not for_table(text).startswith(("=", "+", "-", "@", "\t", "\r"))
    cell = next(csv.reader(io.StringIO(f'"{for_table(text).replace(chr(34), chr(34) * 2)}"')), [""])[0]
    assert cell.removeprefix("'") == one_line(text).removeprefix("'")


@given(st.text(alphabet=st.one_of(st.characters(), st.sampled_from("./\\ -" + string.ascii_letters))))
def test_a_file_name_is_one_part_on_any_system(tmp_path_factory, text):
    name = for_file_name(text)
    assert name
    assert not set(name) & set('/\\:*?"<>|\0')
    assert not name.startswith((".", "-", " "))
    assert not name.endswith((".", " "))
    folder = tmp_path_factory.getbasetemp() / "names"
    folder.mkdir(exist_ok=True)
    (folder / name).touch()
    assert (folder / name).is_file()
    assert for_file_name(name) == name
