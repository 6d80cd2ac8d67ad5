"""The evaluation runs, goes on where it was stopped, and its tables stand on the pages as they were written."""

import ast
import importlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import phytofit
import phytofit.version

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from evaluation import __main__ as evaluation  # noqa: E402  of the repository, not installed
from evaluation import jobs, pages, tables  # noqa: E402

RESULTS = ROOT / "evaluation" / "results"
TABLES = ("table1", "table2", "methods", "ablations")
FROM_DATA = ("real", "real_means", "fig7")
PICTURES = ("fig6a", "fig6b", "fig7abc", "fig7d", "fig8")


def command(out, *arguments):
    return [sys.executable, "-m", "evaluation", "--quick", "--out", out, "--kept", out / "kept", *arguments]


def run(out, *arguments):
    done = subprocess.run(command(out, *arguments), cwd=ROOT, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def called(monkeypatch, capfd):
    """Calls the program in this process, and gives what it prints."""
    monkeypatch.setattr(jobs, "KEPT", jobs.KEPT)  # which it changes

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["evaluation", *map(str, arguments)])
        evaluation.main()
        return capfd.readouterr().out

    return call


def test_table_one_runs_and_is_not_done_twice(tmp_path, called):
    arguments = command(tmp_path, "table1")[3:]
    said = called(*arguments)
    assert "table1 done" in said
    assert "done before" not in said
    first = (tmp_path / "table1.csv").read_bytes()
    assert "2 of them done before" in called(*arguments)
    assert (tmp_path / "table1.csv").read_bytes() == first
    assert "| 20 | 300 |" in (tmp_path / "table1.md").read_text(encoding="utf-8")


def test_another_state_of_the_code_keeps_apart(tmp_path, monkeypatch):
    (tmp_path / "a.py").write_text("x = 1\n")
    monkeypatch.setattr(jobs, "SOURCES", (tmp_path,))
    before = phytofit.version.state_of_the_code(jobs.SOURCES)
    (tmp_path / ".kept").mkdir()
    (tmp_path / ".kept" / "func_code.py").write_text("x = 3\n")  # as joblib does
    assert phytofit.version.state_of_the_code(jobs.SOURCES) == before
    (tmp_path / "a.py").write_text("x = 2\n")
    assert phytofit.version.state_of_the_code(jobs.SOURCES) != before


@pytest.mark.parametrize("path", sorted((ROOT / "evaluation").glob("*.py")), ids=lambda path: path.name)
def test_only_names_that_phytofit_offers_are_used(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    froms = [n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    assert not [name for name in froms if name.split(".")[0] == "phytofit"]
    imports = [alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names]
    used = {ast.unparse(n) for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    for name in (name for name in used if re.fullmatch(r"phytofit(\.\w+)+", name)):
        first, *rest = name.split(".")[1:]
        if f"phytofit.{first}" in imports:
            assert not rest or rest[0] in importlib.import_module(f"phytofit.{first}").__all__, name
        else:
            assert first in {*phytofit.__all__, "__file__"}, name


@pytest.mark.parametrize("arguments", [["--quick"], ["nothing", "--out", "x"]])
def test_what_can_not_be_is_refused(arguments, called, capfd):
    with pytest.raises(SystemExit) as ended:
        called(*arguments)
    assert ended.value.code == 2
    assert "error:" in capfd.readouterr().err


def test_the_interval_of_a_correlation_is_the_bootstraps():
    """SciPy's percentile bootstrap of the same pairs; both draw at random."""
    random = np.random.default_rng(3)
    x = random.normal(size=40)
    y = x + random.normal(size=40)
    mine = tables.interval_of_r(x, y[np.newaxis], draws=2000)
    theirs = stats.bootstrap(
        (x, y), lambda a, b: stats.pearsonr(a, b)[0], paired=True, method="percentile", n_resamples=2000, rng=1,
        vectorized=False,
    ).confidence_interval  # fmt: skip
    assert mine == pytest.approx(theirs, abs=0.03)
    assert tables.interval_of_r(x, np.stack([y, y])) == tables.interval_of_r(x, y[np.newaxis])


def test_marked_places_are_filled_and_nothing_else(tmp_path):
    (tmp_path / "one.md").write_text("| 1 |\n")
    (tmp_path / "two.md").write_text("two\n")
    text = "a\n<!-- one -->\nold\n<!-- end -->\nb\n<!-- two -->\n<!-- end -->\nc <!-- else -->\n"
    once = pages.filled(text, tmp_path)
    assert once == "a\n<!-- one -->\n| 1 |\n<!-- end -->\nb\n<!-- two -->\ntwo\n<!-- end -->\nc <!-- else -->\n"
    assert pages.filled(once, tmp_path) == once


@pytest.mark.parametrize("page", pages.PAGES, ids=lambda page: page.name)
def test_pages_show_the_tables_as_they_were_written(page):
    text = page.read_text(encoding="utf-8")
    assert pages.filled(text, RESULTS) == text
    assert re.search(r"<!-- table2 -->\n\| .*\n(\|.*\n)+<!-- end -->", text)


@pytest.mark.long
def test_the_whole_runs_and_goes_on_where_it_was_killed(tmp_path):
    """What was killed in the middle and started again leaves the same tables as what ran through; times aside."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run(whole)
    process = subprocess.Popen(command(killed), cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True)
    for line in process.stdout:
        if line.startswith("fig6 done"):
            break
    time.sleep(2.0)  # into Table II
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert "done before" in run(killed)
    names = [*TABLES, *(FROM_DATA if (whole / "real.md").exists() else ())]
    for name in names:
        mine, theirs = ((folder / f"{name}.md").read_text(encoding="utf-8") for folder in (killed, whole))
        assert mine.count("\n") > 2
        assert name == "table1" or mine == theirs
    for name in PICTURES:
        if (whole / f"{name}.png").exists():
            assert (killed / f"{name}.png").read_bytes() == (whole / f"{name}.png").read_bytes()
    assert (whole / "fig8.png").exists()
