"""What results look like on disk: nothing half-written, nothing lost."""

from phytofit.io.files import OURS, files_made, is_our_picture, json_text, result_names, write_text
from phytofit.io.log import LOG, open_log
from phytofit.io.models import MESHES, check_meshes, write_mesh
from phytofit.io.phytomer import (
    COLUMNS,
    SEPARATOR,
    fit_tables,
    read_remarks,
    remarks_text,
    save_fit,
    trait_table,
)
from phytofit.io.plant import (
    check_reconstruction,
    leaf_table,
    leaf_tables,
    read_segmentation,
    save_plants,
    save_reconstruction,
    save_segmentation,
)
from phytofit.io.replacing import (
    check_made,
    delete_made,
    file_hash,
    made_in,
    prepare_folder,
    whole_file,
    whole_files,
    whole_folder,
)
from phytofit.io.simulated import save_simulated, save_simulated_plants
from phytofit.io.tables import (
    FolderTable,
    check_table,
    read_table,
    table_text,
    write_failures,
    write_table,
    write_workbook,
)

__all__ = [
    "COLUMNS",
    "LOG",
    "MESHES",
    "OURS",
    "SEPARATOR",
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
    "read_remarks",
    "read_segmentation",
    "read_table",
    "remarks_text",
    "result_names",
    "save_fit",
    "save_plants",
    "save_reconstruction",
    "save_segmentation",
    "save_simulated",
    "save_simulated_plants",
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
