"""What a validation looks like on disk: its tables and its page, all of them or none."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from phytofit.io import check_made, check_table, prepare_folder, whole_files, write_table
from phytofit.report.page import GENERATOR

__all__ = ["save_validation"]

PAGE = "validation.html"


def save_validation(folder: Path, tables: Mapping[str, pd.DataFrame], page: str) -> Path:
    """Write ``folder/NAME.csv`` for each of the tables, and validation.html; the path of the page.

    Those of an earlier run are replaced once all are made.  OutputError if that can't be done, or if a file of one of
    the names is not of an earlier run.
    """
    prepare_folder(folder)
    check_made(folder / PAGE, _is_our_page)
    for name, table in tables.items():
        check_table(folder / f"{name}.csv", list(table.columns))
    with whole_files(folder) as part:
        for name, table in tables.items():
            write_table(part / f"{name}.csv", table)
        (part / PAGE).write_text(page, encoding="utf-8", errors="backslashreplace", newline="")
    return folder / PAGE


def _is_our_page(path: Path) -> bool:
    with path.open(encoding="utf-8", errors="replace") as file:
        return GENERATOR in file.read(10_000)
