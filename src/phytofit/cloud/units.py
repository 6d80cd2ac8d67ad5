"""Units of length: what a centimetre is of each, and whether a cloud can have the size that one gives it."""

from phytofit.errors import UnitError

__all__ = ["SCALE_CM", "checked_unit"]

SCALE_CM = {"cm": 1.0, "mm": 0.1, "m": 100.0, "none": 1.0}  # centimetres per unit


def checked_unit(called: str, units: str | None, across: float, plausible_cm: tuple[float, float]) -> str:
    sizes = {unit: across * SCALE_CM[unit] for unit in ("cm", "mm", "m")}
    ask = "state its unit: mm, cm, m, or none for relative lengths"
    if units is None:
        raise UnitError(
            f"{called}: no unit given; the cloud is {_length(sizes['cm'])} cm across if in cm, "
            f"{_length(sizes['mm'])} cm if in mm, {_length(sizes['m'])} cm if in m; {ask}"
        )
    if units not in SCALE_CM:
        raise UnitError(f"{called}: unknown unit {units!r}; {ask}")
    low, high = plausible_cm
    if units == "none" or low <= sizes[units] <= high:
        return units
    fits = [unit for unit, size in sizes.items() if low <= size <= high]
    advice = "; ".join(f"if in {unit} it is {_length(sizes[unit])} cm" for unit in fits)
    advice = advice or "no other unit fits either; is it one plant, without stray points?"
    raise UnitError(
        f"{called}: the cloud is {_length(sizes[units])} cm across if in {units}, "
        f"expected {low:g} to {high:g} cm; {advice}; state its unit: mm, cm, m, or none for relative lengths"
    )


def _length(value: float) -> str:
    return f"{value:.1f}" if 1 <= value < 1000 else f"{value:.0f}" if 1000 <= value < 1e6 else f"{value:.3g}"
