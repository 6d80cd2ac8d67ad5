"""What results look like on disk: nothing half-written."""

from phytofit.results.files import prepare_folder, result_names, table_text, whole_folder, write_text
from phytofit.results.phytomer import COLUMNS, save_fit, trait_table
from phytofit.results.plant import save_reconstruction

__all__ = [
    "COLUMNS",
    "prepare_folder",
    "result_names",
    "save_fit",
    "save_reconstruction",
    "table_text",
    "trait_table",
    "whole_folder",
    "write_text",
]
