"""Why fit and hand differ on the paper's greenhouse clouds: sections through the points, and what these measure.

    python benchmarks/sections.py [--out sections]

Prints each trait as fitted, with its interval, by hand, and off the points alone, and draws a page a cloud.  The fit
only says where to cut.  Off the points alone are

stem_diameter  of circles through sections of the stem below the leaf, the median
leaf_angle     of the stem's axis, through those circles' centres, and the first 8 cm of a tape
leaf_length    of a tape laid along the middle of the points, from the stem's surface to the tip
leaf_width     of the widest of the sections across the blade
"""

import argparse
import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
from accuracy import HAND
from common import DATA
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.stats import theilslopes
from tape_measure import (
    Ring,
    Section,
    along,
    angle_over,
    direction,
    expected_beyond,
    leaf_of,
    length_of,
    points_at,
    rings_of,
    sections_of,
    tape_along,
)
from trust import covers, fit_real, interval

import phytofit
import phytofit.models
from phytofit.models import move
from phytofit.traits import CHORD_CM

POINTS, FITTED, BY_HAND, MEASURED = "#555555", "#0072B2", "#D55E00", "#009E73"  # Okabe and Ito
STYLES = {FITTED: "-", BY_HAND: "--", MEASURED: "-."}
UNITS = {"cm": " cm", "deg": "°"}


class Cloud(NamedTuple):
    """A cloud, upright as its fit has it, cut into sections, and what its points measure; `more` in words."""

    points: np.ndarray
    blade: phytofit.models.Organ
    start: float  # along the midrib, cm, where it leaves the stem
    traits: dict[str, phytofit.Trait]
    hand: dict[str, float]
    rings: list[Ring]
    leaf: np.ndarray
    tape: np.ndarray
    sections: list[Section]
    measured: dict[str, float]
    more: dict[str, str]

    def says(self, name: str) -> str:
        trait = self.traits[name]
        ends = f"{trait.low:.2f}, {'–' if trait.high is None else f'{trait.high:.2f}'}"
        numbers = f"{trait.value:.2f} [{ends}], hand {self.hand[name]:.2f}, points {self.measured[name]:.2f}"
        return f"{name.replace('_', ' ')} {numbers}{UNITS[trait.unit]}"


def cut(result: phytofit.Fit, hand: dict[str, float]) -> Cloud:
    upright = np.linalg.inv(result.pose)
    points = result.reference @ upright[:3, :3].T + upright[:3, 3]
    blade = move(result.organs, upright)[1]
    traits = {trait.name: trait for trait in result.traits if trait.name in HAND}
    start = float(blade.segment_lengths.sum()) - traits["leaf_length"].value
    rings = rings_of(points, blade.axis[0, 2])
    below = [ring.diameter for ring in rings if ring.height < blade.axis[0, 2]]
    radius = 0.5 * float(np.median(below))
    centers = np.array([ring.center for ring in rings]).T
    lean = [theilslopes(center, [ring.height for ring in rings])[0] for center in centers]
    axis = direction(np.zeros(3), np.array([*lean, 1.0]))
    leaf = leaf_of(points, radius)
    tape = tape_along(leaf, radius)
    length, angle = length_of(tape), angle_over(tape, axis, CHORD_CM)
    sections = sections_of(leaf, blade, start)
    chords = np.arange(1.0, 0.5 * length, 0.5)
    alike = min(chords, key=lambda chord: abs(angle_over(tape, axis, chord) - hand["leaf_angle"]))
    from_axis = length + radius / np.sin(np.deg2rad(angle))
    middle = np.median([section.extent for section in sections if 0.4 < section.at / length < 0.6])
    beyond = expected_beyond(leaf, blade)
    measured = {
        "stem_diameter": 2.0 * radius,
        "leaf_angle": angle,
        "leaf_length": length,
        "leaf_width": max(section.extent for section in sections),
    }
    more = {
        "stem_diameter": f"{len(below)} sections, {min(below):.2f} to {max(below):.2f}",
        "leaf_angle": f"{hand['leaf_angle']:.1f} over {alike:.1f} cm of the tape",
        "leaf_length": f"from the stem's axis {from_axis:.1f}; the fit expects {beyond:.0f} points beyond",
        "leaf_width": f"half-way along the leaf {middle:.2f}",
    }
    return Cloud(points, blade, start, traits, hand, rings, leaf, tape, sections, measured, more)


def draw(name: str, cloud: Cloud) -> Figure:
    figure = Figure(figsize=(12.0, 12.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(h_pad=0.08, w_pad=0.08)
    grid = figure.add_gridspec(4, 12, height_ratios=[2.6, 2.6, 2.3, 2.5])
    draw_ring(figure.add_subplot(grid[0, :3]), cloud)
    draw_stem(figure.add_subplot(grid[1, :3]), cloud)
    draw_side(figure.add_subplot(grid[:2, 3:8]), cloud)
    draw_base(figure.add_subplot(grid[:2, 8:]), cloud)
    length = cloud.traits["leaf_length"].value
    places = {
        "a quarter along the leaf": min(cloud.sections, key=lambda section: abs(section.at - 0.25 * length)),
        "half-way": min(cloud.sections, key=lambda section: abs(section.at - 0.5 * length)),
        "where the points are widest": max(cloud.sections, key=lambda section: section.extent),
    }
    for i, (place, section) in enumerate(places.items()):
        draw_section(figure.add_subplot(grid[2, 4 * i : 4 * i + 4]), place, section, cloud.hand["leaf_width"])
    draw_unrolled(figure.add_subplot(grid[3, :]), cloud)
    for ax in figure.axes:
        ax.grid(alpha=0.25)
        ax.title.set_fontsize(10)
    labels = {FITTED: "fit, with 95 % interval", BY_HAND: "by hand", MEASURED: "off the points alone"}
    handles = [Line2D([], [], marker="o", linestyle="", markersize=4, color=POINTS, label="points of the cloud")]
    handles += [Line2D([], [], color=c, lw=2.2, ls=STYLES[c], label=label) for c, label in labels.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=11)
    lines = [name, *("; ".join(map(cloud.says, pair)) for pair in (("stem_diameter", "leaf_angle"), list(HAND)[2:]))]
    figure.suptitle("\n".join(lines), fontsize=12)
    return figure


def draw_ring(ax: Axes, cloud: Cloud) -> None:
    """The section of the stem whose circle is nearest to the median, with fit and hand about the fitted axis."""
    below = [ring for ring in cloud.rings if ring.height < cloud.blade.axis[0, 2]]
    ring = min(below, key=lambda ring: abs(ring.diameter - cloud.measured["stem_diameter"]))
    ax.scatter(*ring.points.T, s=7, c=POINTS, linewidths=0)
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    diameters = {
        FITTED: cloud.traits["stem_diameter"].value,
        BY_HAND: cloud.hand["stem_diameter"],
        MEASURED: ring.diameter,
    }
    for color, diameter in diameters.items():
        x, y = ring.center if color == MEASURED else (0.0, 0.0)
        radius = 0.5 * diameter
        ax.plot(x + radius * np.cos(turn), y + radius * np.sin(turn), color=color, ls=STYLES[color], lw=1.6)
    ax.set_title(f"stem, {cloud.blade.axis[0, 2] - ring.height:.0f} cm below the leaf")
    ax.set(aspect="equal", xlim=(-2.7, 2.7), ylim=(-2.7, 2.7), xlabel="across the stem, cm", ylabel="across, cm")


def draw_stem(ax: Axes, cloud: Cloud) -> None:
    """Diameter of the circle of each section along the stem."""
    trait = cloud.traits["stem_diameter"]
    base = cloud.blade.axis[0, 2]
    heights = [ring.height - base for ring in cloud.rings]
    ax.axvspan(trait.low, trait.high, color=FITTED, alpha=0.25, lw=0)
    lines = {FITTED: trait.value, BY_HAND: cloud.hand["stem_diameter"], MEASURED: cloud.measured["stem_diameter"]}
    for color, diameter in lines.items():
        ax.axvline(diameter, color=color, ls=STYLES[color], lw=1.6)
    ax.plot([ring.diameter for ring in cloud.rings], heights, "s", color=MEASURED, markersize=4)
    ax.axhline(0.0, color="black", lw=0.8, ls=":")
    ax.set_title("circle of each section of the stem")
    ax.set(xlabel="diameter, cm", ylabel="above the leaf's base, cm")


def draw_side(ax: Axes, cloud: Cloud) -> None:
    """The cloud, midrib and tape in the plane of the stem's axis and the chord to which leaf_angle is measured."""
    collar, end = points_at(cloud.blade.axis, np.array([cloud.start, cloud.start + CHORD_CM]))
    out = direction(collar[:2], end[:2])
    ax.plot(cloud.blade.axis[:, :2] @ out, cloud.blade.axis[:, 2], color=FITTED, lw=2.5)
    ax.plot(cloud.tape[:, :2] @ out, cloud.tape[:, 2], color=MEASURED, ls="-.", lw=1.4)
    ax.scatter(cloud.points[:, :2] @ out, cloud.points[:, 2], s=5, c=POINTS, linewidths=0, alpha=0.6, zorder=1)
    ax.axvline(0.0, color="black", lw=0.8, ls=":")
    ax.set_title("from the side, with midrib and tape")
    ax.set(aspect="equal", xlabel="from the stem's axis, cm", ylabel="up the stem, cm")


def draw_base(ax: Axes, cloud: Cloud) -> None:
    """The same near the leaf's base, with rays at the leaf's angle from the stem's axis."""
    draw_side(ax, cloud)
    collar, end = points_at(cloud.blade.axis, np.array([cloud.start, cloud.start + CHORD_CM]))
    foot = np.array([collar[:2] @ direction(collar[:2], end[:2]), collar[2]])
    trait = cloud.traits["leaf_angle"]
    fan = np.deg2rad(np.linspace(trait.low, trait.high, 30))
    reach = CHORD_CM * np.stack([np.sin(fan), np.cos(fan)], axis=1)
    ax.fill(*np.vstack([foot, foot + reach]).T, color=FITTED, alpha=0.25, lw=0)
    for angle, color in ((trait.value, FITTED), (cloud.hand["leaf_angle"], BY_HAND)):
        ray = 1.6 * CHORD_CM * np.array([np.sin(np.deg2rad(angle)), np.cos(np.deg2rad(angle))])
        ax.plot(*np.stack([foot, foot + ray]).T, color=color, lw=1.6, ls=STYLES[color])
    ax.set(xlim=(-3.0, 15.0), ylim=(foot[1] - 9.0, foot[1] + 12.0), ylabel="")
    ax.set_title(f"its base: rays at the leaf's angle,\nfan over the chord of {CHORD_CM:g} cm")


def draw_section(ax: Axes, place: str, section: Section, hand: float) -> None:
    ax.scatter(*section.points.T, s=7, c=POINTS, linewidths=0)
    middle = section.points[:, 0].mean()
    ax.plot([-0.5 * section.fitted, 0.5 * section.fitted], [0.0, 0.0], color=FITTED, lw=2.5)
    for width, color, y in ((hand, BY_HAND, -3.4), (section.extent, MEASURED, -3.9)):
        ax.plot([middle - 0.5 * width, middle + 0.5 * width], [y, y], color=color, ls=STYLES[color], lw=2.5)
    widths = f"fit {section.fitted:.2f}, hand {hand:.2f}, points {section.extent:.2f}"
    ax.set_title(f"blade {place}, at {section.at:.0f} cm:\n{widths} cm")
    ax.set(aspect="equal", xlim=(-6.0, 6.0), ylim=(-4.4, 3.2), xlabel="across the blade, cm", ylabel="off it, cm")


def draw_unrolled(ax: Axes, cloud: Cloud) -> None:
    """The leaf's points along and across the fitted midrib."""
    blade, trait = cloud.blade, cloud.traits["leaf_length"]
    node_at = np.concatenate([[0.0], np.cumsum(blade.segment_lengths)])
    at = along(cloud.leaf, blade.axis)
    segment = np.clip(np.searchsorted(node_at, at) - 1, 0, len(blade.frame) - 1)
    across = np.einsum("na,na->n", cloud.leaf - points_at(blade.axis, at), blade.frame[segment, :, 1])
    ax.scatter(at - cloud.start, across, s=4, c=POINTS, linewidths=0)
    for side in (-1.0, 1.0):
        ax.plot(node_at - cloud.start, side * blade.half_width, color=FITTED, lw=1.6)
        ax.axhline(side * 0.5 * cloud.hand["leaf_width"], color=BY_HAND, ls="--", lw=1.0)
    end = max(cloud.hand["leaf_length"], trait.value) + 4.0
    ax.axvspan(trait.low, end if trait.high is None else trait.high, color=FITTED, alpha=0.25, lw=0)
    lines = {FITTED: trait.value, BY_HAND: cloud.hand["leaf_length"], MEASURED: cloud.measured["leaf_length"]}
    for color, length in lines.items():
        ax.axvline(length, color=color, ls=STYLES[color], lw=1.6)
    ax.set_title("blade unrolled along the fitted midrib: outline, and length as upright lines")
    ax.set(aspect="equal", xlim=(-3.0, end), ylim=(-6.5, 6.5))
    ax.set(xlabel="along the midrib from the stem's surface, cm", ylabel="across, cm")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("sections"), help="folder of the pictures")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    with (DATA / "greenhouse" / "ground_truth.csv").open() as file:
        table = list(csv.DictReader(file))
    print(f"{'cloud':12}{'trait':15}{'fitted':>8}{'interval':>17}{'hand':>8}{'points':>8}  points nearer to")
    nearer, held = [], []
    for row in table:
        name, hand = row["cloud"], {trait: float(row[column]) for trait, column in HAND.items()}
        cloud = cut(fit_real(DATA / "greenhouse" / f"{name}.ply"), hand)
        draw(name, cloud).savefig(folder / f"sections_{name}.png", dpi=80, metadata={"Software": None})
        for trait, by_hand in hand.items():
            fitted, points = cloud.traits[trait], cloud.measured[trait]
            nearer.append("fit" if abs(points - fitted.value) < abs(points - by_hand) else "hand")
            held.append((covers(fitted, by_hand), covers(fitted, points)))
            numbers = f"{fitted.value:8.2f}{interval(fitted):>17}{by_hand:8.2f}{points:8.2f}"
            print(f"{name:12}{trait:15}{numbers}  {nearer[-1]:6}{cloud.more[trait]}", flush=True)
    print(f"the points are nearer to the fit in {nearer.count('fit')} of {len(nearer)}")
    print("the intervals hold the hand's in {:.0f}, the points' in {:.0f}".format(*np.sum(held, axis=0)))


if __name__ == "__main__":
    main()
