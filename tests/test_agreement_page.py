"""The page of a validation: what is drawn stays where it can be seen, and names are text."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Annotation

from phytofit.plots import plot_agreement, plot_trials
from phytofit.report import agreement_page
from phytofit.validation import PAIR_COLUMNS, Comparison, agreement


def pairs_of(names, open_low=(), open_high=(), without=()):
    """Pairs of random lengths; of some the interval has no low end, no high end, or none."""
    random = np.random.default_rng(len(names))
    hand = random.uniform(40.0, 80.0, len(names))
    value = hand + random.normal(0.0, 2.0, len(names))
    rows = [
        (
            name,
            "leaf_length",
            "cm",
            hand[i],
            value[i],
            np.nan if i in (*open_low, *without) else value[i] - 3.0,
            np.nan if i in (*open_high, *without) else value[i] + 3.0,
            "",
            "",
            1,
        )
        for i, name in enumerate(names)
    ]
    return pd.DataFrame(rows, columns=PAIR_COLUMNS)


def annotations(ax):
    return [child for child in ax.get_children() if isinstance(child, Annotation)]


@pytest.mark.parametrize("n", [1, 2, 8])
def test_names_stay_within_the_axes(n):
    names = [
        "greenhouse_2024-05-03_block_7_plant_0012",
        "a",
        "0015_occl1",
        "$x^2$",
        "WWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWW",
    ]
    pairs = pairs_of([f"{i} {names[i % 5]}" for i in range(n)])
    (found,) = agreement(pairs)
    figure = plot_agreement(pairs, found)
    figure.draw_without_rendering()
    difference = figure.axes[1]
    frame = difference.get_window_extent()
    written = [text for text in annotations(difference) if "\n" not in text.get_text()]
    assert len(written) == n
    for text in written:
        box = text.get_window_extent()
        assert frame.x0 <= box.x0 < box.x1 <= frame.x1, text.get_text()
        assert frame.y0 <= box.y0 < box.y1 <= frame.y1, text.get_text()
    assert not any(
        a.get_window_extent().overlaps(b.get_window_extent()) for a in written for b in written if a is not b
    )


def test_an_interval_without_an_end_has_an_arrow_there():
    pairs = pairs_of(list("abcdef"), open_low=(1,), open_high=(0, 3), without=(5,))
    (found,) = agreement(pairs)
    scatter = plot_agreement(pairs, found).axes[0]
    arrows = {text.xy[0]: text.xyann[1] for text in annotations(scatter) if text.arrow_patch is not None}
    up = dict(zip(pairs["measured"].iloc[[0, 1, 3]], (True, False, True), strict=True))
    assert {x: tip > 0.0 for x, tip in arrows.items()} == up
    low, high = scatter.get_ylim()
    assert low < pairs["low"].min()
    assert pairs["high"].max() < high
    assert scatter.get_xlim() == (low, high)


def test_axis_labels_of_trials_fit_their_axes():
    rows = [
        (s, v, t, "cm", 3, 0.1, 0.2, 0.9, 1.0, 0, 0)
        for s in ("points", "cameras")
        for v in (1, 2)
        for t in ("leaf_length",)
    ]
    columns = ["setting", "value", "trait", "unit", "n", "bias", "rmse", "within", "coverage", "good", "refused"]
    figure = plot_trials(pd.DataFrame(rows, columns=columns), 12.5, 12.5)
    figure.draw_without_rendering()
    for ax in figure.axes[::2]:
        box, frame = ax.yaxis.label.get_window_extent(), ax.get_window_extent()
        assert frame.y0 <= box.y0 < box.y1 <= frame.y1


def test_names_and_remarks_are_text_on_the_page():
    script = "<script>alert(1)</script>"
    pairs = pairs_of([f"{script}{i}" for i in range(8)])
    comparison = Comparison(pairs, (f"no result: {script}",), (f"column {script} is not read",))
    page = agreement_page(comparison, agreement(pairs), f"Results in {script}")
    assert script not in page
    assert page.count("&lt;script&gt;") == 4  # twice in the title
    assert "Notes" in page
    assert "leaf length (cm)" in page
