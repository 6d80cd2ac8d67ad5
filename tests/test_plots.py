"""Pictures of a fit: what is written on them can be read."""

import io
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

import phytofit


@pytest.fixture(scope="module")
def fitted():
    """A phytomer that is about as high, seen from the front, as the picture, with a stray point beside it."""
    fixed = {"leaf_length": 55.0, "leaf_angle": 50.0, "leaf_width": 6.0, "stem_length": 15.0, "stem_length_above": 13.0}
    result = phytofit.fit(phytofit.simulate(fixed=fixed, n_points=1500, seed=4).points, "cm", threads=2)
    stray = result.pose[:3, :3] @ [2.0, 7.0, 2.0] + result.pose[:3, 3]
    return replace(result, reference=np.concatenate([result.reference, [stray]]))


@pytest.mark.parametrize("n_flags", range(7))
def test_no_words_of_the_picture_lie_on_others(fitted, n_flags):
    figure = phytofit.plot_fit(replace(fitted, flags=("the tip was not seen",) * n_flags), "cloud")
    figure.savefig(io.BytesIO(), format="png", dpi=figure.dpi)
    words = [figure._suptitle, *figure.legends[0].get_texts()]  # the title has no public name
    words += [text for ax in figure.axes for text in (ax.title, ax.xaxis.label)]
    for one, other in combinations(words, 2):
        assert not one.get_window_extent().overlaps(other.get_window_extent()), (one, other)
