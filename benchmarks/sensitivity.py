"""What half and twice of each judged number do to the default method's results.

    python benchmarks/sensitivity.py [--numbers search.HOPELESS tip.WINDOW] [--leaves 2] [--minutes 15]
    python benchmarks/sensitivity.py --tests tests/test_likelihood.py tests/test_tip.py [--most 40] [--minutes 20]
    python benchmarks/sensitivity.py --list

A judged number is a numeric constant of a module that no equation and no unit gives.  The script finds those of
engine/, results/, start/ and of the kernels that these import; NOT_JUDGED says what is left out, and why.  Each is
halved and doubled in turn in a copy of the sources, and so many simulated, foreign and, where they are, real clouds
are fitted anew.  The table in docs/numbers.md is made by this.  What was measured is kept, so a run that was stopped
goes on where it was; when the sources change, all is measured anew.  All numbers take hours.
"""

import argparse
import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "src" / "phytofit"
PAGE = ROOT / "docs" / "numbers.md"
KEPT = ROOT / "evaluation" / ".kept" / "sensitivity.json"
FOLDERS = ("engine", "results", "start")
FACTORS = (0.5, 2.0)
NO_EFFECT = 0.01  # of the half width of an interval: rounding moves a trait by less
LONGEST_S = 1200  # for which one changed copy may run
NOT_JUDGED = {  # name, or module.name: why
    "dependence.MIDDLES_CM": "follows from others",
    "dependence.NONE": "no number",
    "covariance.LEAST_KNOWN": "numerical precision",
    "evidence.LEAST_KNOWN": "numerical precision",
    "leaf_end.STEP": "numerical precision",
    "leaf_end.NOTHING": "numerical precision",
    "posterior.STEP": "numerical precision",
    "posterior.PLACE_STEP": "numerical precision",
    "posterior.FACING_STEP": "numerical precision",
    "posterior.RING": "no number",
    "visibility.CELLS": "follows from others",
    "prior.NO_THICKNESS_CM": "numerical precision",
    "leaf_end.NODES": "equation",
    "leaf_end.SHARES": "equation",
    "leaf_end.STRAY": "numerical precision",
    "tip.THIN": "numerical precision",
    "tip.N_PROFILE": "numerical precision",
    "tip.STRAY": "numerical precision",
    "review.NEAR_BOUND": "numerical precision",
    "scoring.NO_DAMPING": "numerical precision",
    "scoring.LEAST_DAMPING": "numerical precision",
    "scoring.MOST_DAMPING": "numerical precision",
    "prepare.CANONICAL_DECIMALS": "numerical precision",
    "likelihood.FARTHEST": "numerical precision",
    "likelihood.ROOT_TWO_PI": "equation",
    "likelihood.CHANGES": "equation",
    "mixture.BLOCK": "speed alone",
    "icp.BLOCK": "speed alone",
    "nearest.MAX_CELLS": "speed alone",
    "nearest.MAX_BINS": "speed alone",
    "target_leaf.NOBODY": "a label",
}


class Number(NamedTuple):
    """A judged number: the file under src/phytofit, its name and text, its comment, and where its value stands."""

    file: str
    name: str
    text: str
    why: str
    node: ast.expr

    @property
    def key(self) -> str:
        return f"{Path(self.file).stem}.{self.name}"


Run = dict[str, dict[str, Any]]  # of each cloud: traits as [value, half width], flags, whether it was refused


def numbers() -> Iterator[Number]:
    """All judged numbers of the default method, module by module."""
    files = [path for folder in FOLDERS for path in sorted((SOURCES / folder).rglob("*.py"))]
    kernels = {name for path in files for name in re.findall(r"phytofit\.kernels\.(\w+)", path.read_text("utf-8"))}
    for path in files + [SOURCES / "kernels" / f"{name}.py" for name in sorted(kernels)]:
        text = path.read_text(encoding="utf-8")
        for name, value in _assigned(ast.parse(text)):
            if not name.isupper() or not _is_numeric(value):
                continue
            comment = text.splitlines()[value.lineno - 1].partition("  # ")[2]
            written = ast.get_source_segment(text, value) or ""
            found = Number(path.relative_to(SOURCES).as_posix(), name, written, comment, value)
            if found.key not in NOT_JUDGED:
                yield found


def _assigned(module: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    """The names that a module gives to values at its head, one by one where a line names several, and the values."""
    for node in module.body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        if isinstance(target, ast.Name) and value is not None:
            yield target.id, value
        elif isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for name, one in zip(target.elts, value.elts, strict=False):
                if isinstance(name, ast.Name):
                    yield name.id, one


def _is_numeric(value: ast.expr) -> bool:
    """Whether an expression holds numbers, and neither text nor mappings."""
    constants = [node.value for node in ast.walk(value) if isinstance(node, ast.Constant)]
    plain = all(isinstance(c, int | float) and not isinstance(c, bool) for c in constants)
    return bool(constants) and plain and not any(isinstance(n, ast.Dict | ast.Set) for n in ast.walk(value))


def scaled(number: Number, factor: float) -> str | None:
    """The number's new text; None where a count of one can't be halved."""
    try:
        value = ast.literal_eval(number.node)
    except ValueError:  # an expression
        return f"({factor} * ({number.text}))"
    new = _times(value, factor)
    return None if new == value else repr(new)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_times(v, factor) for v in value)
    if isinstance(value, int):
        return value if value == 0 else int(np.copysign(max(1, round(abs(value) * factor)), value))
    return value * factor


def in_copy(number: Number | None, factor: float, command: Sequence[str]) -> subprocess.CompletedProcess[str] | None:
    """What a command ends with if the number is changed; None where it can't be, or takes too long."""
    new = None if number is None else scaled(number, factor)
    if number is not None and new is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "phytofit"
        shutil.copytree(SOURCES, package, ignore=shutil.ignore_patterns("__pycache__"))
        if number is not None:
            file = package / number.file
            lines = file.read_bytes().splitlines(keepends=True)
            first, last = number.node.lineno - 1, (number.node.end_lineno or number.node.lineno) - 1
            after = lines[last][number.node.end_col_offset :]
            lines[first : last + 1] = [lines[first][: number.node.col_offset] + str(new).encode() + after]
            file.write_bytes(b"".join(lines))
        try:
            return subprocess.run(
                [sys.executable, *command],
                cwd=ROOT,
                env={**os.environ, "PYTHONPATH": folder},
                capture_output=True,
                text=True,
                timeout=LONGEST_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return None


def sample(n: int) -> Run:
    """The fits of n clouds of each kind, by the phytofit that is imported."""
    import common  # noqa: PLC0415
    import foreign  # noqa: PLC0415

    import phytofit  # noqa: PLC0415

    kinds: dict[str, Callable[[int], phytofit.PointCloud]] = {
        "simulated": lambda i: phytofit.from_points(phytofit.simulate(seed=i).points, "cm"),
        "foreign": lambda i: phytofit.from_points(foreign.cloud(i)[0], "cm"),
    }
    if common.DATA.is_dir():
        real = common.clouds("greenhouse")
        kinds["real"] = lambda i: common.read(real[i % len(real)])
    return {f"{kind} {i}": _fitted(make(i)) for kind, make in kinds.items() for i in range(n)}


def _fitted(cloud: Any) -> dict[str, Any]:
    import phytofit  # noqa: PLC0415

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a changed number may divide by nothing
        try:
            result = phytofit.fit(cloud, threads=1)
        except Exception as error:  # whatever the changed number makes it raise is its effect
            return {"traits": {}, "flags": [], "refused": type(error).__name__}
    ends = {t.name: [t.value, t.high - t.low] for t in result.traits if t.low is not None and t.high is not None}
    traits = {name: [value, 0.5 * width] for name, (value, width) in ends.items()}
    return {"traits": traits, "flags": sorted(result.flags), "refused": ""}


def effect(plain: Run, changed: Run | None) -> str:
    """What a changed number does, as a cell of the table."""
    if changed is None:
        return "–"
    moved: dict[str, list[float]] = {}
    for cloud, before in plain.items():
        for trait, (value, half) in before["traits"].items():
            if half > 0.0 and trait in changed[cloud]["traits"]:
                moved.setdefault(trait, []).append(abs(changed[cloud]["traits"][trait][0] - value) / half)
    refused = sum(changed[c]["refused"] != plain[c]["refused"] for c in plain)
    flags = sum(changed[c]["flags"] != plain[c]["flags"] for c in plain)
    cells = [
        f"{trait} {np.median(by):.2f} ({max(by):.2f})" for trait, by in sorted(moved.items()) if max(by) > NO_EFFECT
    ]
    cells += [f"refusals of {refused} clouds"] if refused else []
    cells += [f"flags of {flags} clouds"] if flags else []
    return "; ".join(cells) or "no effect"


def measure(found: Sequence[Number], chosen: set[str], leaves: int, until: float) -> dict[str, list[str]]:
    """The cells for half and twice of each number, as far as time allows; what was kept comes at once."""
    from phytofit.version import state_of_the_code  # noqa: PLC0415

    of = f"{state_of_the_code()} {leaves}"
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.is_file() else {}
    if kept.get("of") != of:
        kept = {"of": of, "runs": {}}

    def run(number: Number | None, factor: float) -> Run | None:
        key = f"{number.file}:{number.name} {factor}" if number else "plain"
        if key not in kept["runs"]:
            ended = in_copy(number, factor, [__file__, "--sample", str(leaves)])
            if ended is not None and ended.returncode and number is None:
                sys.exit(ended.stderr)
            failed = ended is None or ended.returncode != 0
            kept["runs"][key] = None if failed or ended is None else json.loads(ended.stdout.splitlines()[-1])
            KEPT.parent.mkdir(parents=True, exist_ok=True)
            KEPT.write_text(json.dumps(kept), encoding="utf-8")
        result: Run | None = kept["runs"][key]
        return result

    plain = run(None, 1.0)
    assert plain is not None
    cells = {}
    for number in found:
        known = all(f"{number.file}:{number.name} {factor}" in kept["runs"] for factor in FACTORS)
        if known or (number.key in chosen and time.monotonic() < until):
            cells[number.key] = [effect(plain, run(number, factor)) for factor in FACTORS]
            print(f"{number.key:32} {number.text:22} half: {cells[number.key][0]}", flush=True)
            print(f"{'':55} twice: {cells[number.key][1]}", flush=True)
    return cells


def write_page(found: Sequence[Number], cells: dict[str, list[str]], leaves: int) -> None:
    rows = ["| module | number | value | chosen by | at half | at twice |", "|---|---|---|---|---|---|"]
    for n in found:
        half, twice = cells.get(n.key, ["not measured", "not measured"])
        why, value = (text.replace("|", "\\|").replace("\n", " ") for text in (n.why or "not said", n.text))
        rows.append(f"| `{n.file}` | `{n.name}` | `{value}` | {why} | {half} | {twice} |")
    missing = len(found) - len(cells)
    head = (
        f"{len(found)} judged numbers; {len(cells)} are measured, {missing} are not yet. Clouds of each kind: {leaves}."
    )
    text = PAGE.read_text(encoding="utf-8")
    table = f"<!-- numbers -->\n{head}\n\n" + "\n".join(rows) + "\n<!-- end -->"
    PAGE.write_text(
        re.sub(r"<!-- numbers -->\n.*?<!-- end -->", lambda _: table, text, flags=re.DOTALL), encoding="utf-8"
    )


def tests_that_notice(chosen: Sequence[Number], files: Sequence[str], until: float) -> None:
    """Print for each number whether the tests in these files fail at half and at twice of it, and which first."""
    noticed = tried = 0
    command = ["-m", "pytest", "-n0", "-x", "-p", "no:cacheprovider", *files]
    if (plain := in_copy(None, 1.0, command)) is None or plain.returncode:
        sys.exit("the tests fail, or take too long, with no number changed")
    for number in chosen:
        if time.monotonic() > until:
            break
        said = []
        for factor in FACTORS:
            ended = in_copy(number, factor, command)
            failed = re.search(r"^(?:FAILED|ERROR) (\S+)", ended.stdout, re.MULTILINE) if ended else None
            said.append("–" if ended is None else failed[1] if failed else "fails" if ended.returncode else "passes")
        tried += 1
        noticed += any(text not in ("–", "passes") for text in said)
        print(f"{number.key:32} half: {said[0]}  twice: {said[1]}", flush=True)
    print(f"tests notice {noticed} of {tried} numbers")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--numbers", nargs="+", help="as module.NAME; all by default")
    parser.add_argument("--leaves", type=int, default=2, help="clouds of each kind")
    parser.add_argument("--minutes", type=float, default=np.inf, help="after which no further number is begun")
    parser.add_argument("--tests", nargs="+", metavar="FILE", help="run these tests in place of fits")
    parser.add_argument("--most", type=int, default=40, help="numbers for --tests, spread over all modules")
    parser.add_argument("--list", action="store_true", help="only print what is judged")
    parser.add_argument("--sample", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.sample is not None:
        print(json.dumps(sample(arguments.sample)))
        return
    found = list(numbers())
    if unknown := set(arguments.numbers or ()) - {number.key for number in found}:
        sys.exit(f"no judged number is called {', '.join(sorted(unknown))}; --list prints all")
    chosen = [number for number in found if not arguments.numbers or number.key in arguments.numbers]
    until = time.monotonic() + 60.0 * arguments.minutes
    if arguments.list:
        for number in found:
            print(f"{number.key:32} {number.text:40} {number.why}")
        print(len(found))
    elif arguments.tests:
        some = np.unique(np.linspace(0, len(chosen) - 1, min(arguments.most, len(chosen))).round().astype(int))
        tests_that_notice([chosen[i] for i in some], arguments.tests, until)
    else:
        cells = measure(found, {number.key for number in chosen}, arguments.leaves, until)
        write_page(found, cells, arguments.leaves)


if __name__ == "__main__":
    main()
