"""Which plant of a cloud is which."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from phytofit.plots.page import GREY, LARGE, MARGIN_IN, NORMAL, PAGE_IN, SPACE_IN, Line, Page, Table, folded
from phytofit.plots.plant import LEAF_COLORS
from phytofit.plots.views import View, arranged, widest_side
from phytofit.segmentation import Segmentation

__all__ = ["plot_plants"]

MOST_DRAWN = 30_000  # points
HIGHEST_IN = 7.0  # of the views
DOTTED = 1.2  # dots, as a share of the room that the plants take up
TABLE_IN = 2.6  # width of the table, and of its columns
COLUMNS_IN = (0.6, 0.8, 1.2)


def plot_plants(results: Sequence[Segmentation], title: str = "") -> Figure:
    """The plants of a cloud, coloured and numbered, upright from the side and from above, beside a list of them."""
    up = results[0].up
    bases = np.array([result.stem_path[0] for result in results])
    side = widest_side(bases - bases.mean(axis=0), up)
    views = (
        View("from the side", np.stack([side, up])),
        View("from above", np.stack([side, np.cross(up, side)])),
    )
    step = max(1, sum(len(result.cloud) for result in results) // MOST_DRAWN)
    clouds = [result.plant.take(np.flatnonzero(result.labels)).points[::step] for result in results]
    heading = [Line(text, LARGE, bold=True) for text in folded(title, TABLE_IN, 2, LARGE, bold=True)]
    heading.append(Line(f"{len(results)} plants in one cloud", color=GREY))
    rows = [tuple((Line(text, color=GREY),) for text in ("plant", "leaves", "points"))]
    for number, result in enumerate(results, start=1):
        n_points = int(np.count_nonzero(result.labels))
        cells = (Line(str(number), NORMAL, bold=True), Line(str(len(result.leaves)), NORMAL), Line(f"{n_points:,}"))
        rows.append(tuple((cell,) for cell in cells))
    colors = [LEAF_COLORS[i % len(LEAF_COLORS)] for i in range(len(results))]
    table = Table(COLUMNS_IN, ("right",) * 3, tuple(rows), (None, *colors))
    room = PAGE_IN - TABLE_IN - 3.0 * MARGIN_IN
    left = 2.0 * MARGIN_IN + room
    beside = sum(line.height for line in heading) + SPACE_IN + table.height
    shown = arranged(views, np.concatenate([*clouds, bases]), room, max(HIGHEST_IN, beside))
    page = Page(max(shown.height, beside) + 2.0 * MARGIN_IN)
    table.draw(page, left, page.write_all(left, MARGIN_IN, heading) + SPACE_IN)
    unit = "rel" if results[0].cloud.unit == "none" else "cm"
    panels = shown.panels(page, MARGIN_IN + 0.5 * (room - shown.width), MARGIN_IN, unit)
    size = min(panel.dot_size(np.concatenate(clouds), DOTTED) for panel in panels)
    for panel in panels:
        for points, color in zip(clouds, colors, strict=True):
            panel.dots(points, color, size=size)
        for number, (points, color) in enumerate(zip(clouds, colors, strict=True), start=1):
            panel.label(str(number), points[int(np.argmax(points @ up))], color=color, ring=True)
    panels[0].up_arrow(bases[int(np.argmin(bases @ up))], up)
    return page.figure
