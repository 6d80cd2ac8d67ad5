"""What results look like on disk: nothing half-written, nothing lost."""

from phytofit.results.files import OURS, files_made, is_our_picture, json_text, result_names, write_text
from phytofit.results.log import LOG, open_log
from phytofit.results.models import MESHES, check_meshes, write_mesh
from phytofit.results.phytomer import COLUMNS, fit_tables, save_fit, trait_table
from phytofit.results.plant import (
    check_reconstruction,
    leaf_table,
    leaf_tables,
    read_segmentation,
    save_plants,
    save_reconstruction,
    save_segmentation,
)
from phytofit.results.replacing import (
    check_made,
    delete_made,
    file_hash,
    made_in,
    prepare_folder,
    whole_file,
    whole_files,
    whole_folder,
)
from phytofit.results.simulated import save_simulated
from phytofit.results.tables import (
    FolderTable,
    check_table,
    read_table,
    table_text,
    write_failures,
    write_table,
    write_workbook,
)
from phytofit.results.validation import save_validation

__all__ = [
    "COLUMNS",
    "LOG",
    "MESHES",
    "OURS",
    "FolderTable",
    "check_made",
    "check_meshes",
    "check_reconstruction",
    "check_table",
    "delete_made",
    "file_hash",
    "files_made",
    "fit_tables",
    "is_our_picture",
    "json_text",
    "leaf_table",
    "leaf_tables",
    "made_in",
    "open_log",
    "prepare_folder",
    "read_segmentation",
    "read_table",
    "result_names",
    "save_fit",
    "save_plants",
    "save_reconstruction",
    "save_segmentation",
    "save_simulated",
    "save_validation",
    "table_text",
    "trait_table",
    "whole_file",
    "whole_files",
    "whole_folder",
    "write_failures",
    "write_mesh",
    "write_table",
    "write_text",
    "write_workbook",
]
