"""What results look like on disk: nothing half-written."""

from phytofit.results.files import prepare_folder, result_names, table_text, whole_file, whole_folder, write_text
from phytofit.results.phytomer import COLUMNS, save_fit, trait_table
from phytofit.results.plant import leaf_table, read_segmentation, save_reconstruction, save_segmentation

__all__ = [
    "COLUMNS",
    "leaf_table",
    "prepare_folder",
    "read_segmentation",
    "result_names",
    "save_fit",
    "save_reconstruction",
    "save_segmentation",
    "table_text",
    "trait_table",
    "whole_file",
    "whole_folder",
    "write_text",
]
