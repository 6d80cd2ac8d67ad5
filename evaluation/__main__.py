"""The paper's tables and figures: ``python -m evaluation``, from the repository's root."""

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

from evaluation import ablations, figure6, figure7, figure8, jobs, table1, table2
from evaluation.jobs import console
from evaluation.pages import fill
from evaluation.settings import FULL, QUICK, Budget

PARTS = {
    "table1": table1.make,
    "fig6": figure6.make,
    "table2": table2.make,
    "fig8": figure8.make,
    "fig7": figure7.make,
    "ablations": ablations.make,
}
RESULTS = Path(__file__).parent / "results"


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m evaluation",
        description="Regenerates the paper's tables and figures.  Stopped, it goes on where it was.",
        epilog="Writes tables and pictures to evaluation/results, docs/accuracy.md and docs/evaluation.md.",
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)}; all by default")
    parser.add_argument("--full", action="store_true", help="without the limits on peers, ablations and the baseline")
    parser.add_argument("--quick", action="store_true", help="tries it: small numbers, none of which means anything")
    parser.add_argument(
        "--out", type=Path, default=RESULTS, help="another folder than evaluation/results; no page changes"
    )
    parser.add_argument("--kept", type=Path, default=jobs.KEPT, help="folder of what is done, to go on from")
    arguments = parser.parse_args()
    unknown = [part for part in arguments.parts if part not in PARTS]
    if unknown:
        parser.error(f"no part is called {', '.join(unknown)}; there are {', '.join(PARTS)}")
    if arguments.quick and arguments.out == RESULTS:
        parser.error("--quick needs --out: its numbers mean nothing, and must not stand on a page")
    jobs.KEPT = arguments.kept
    arguments.out.mkdir(parents=True, exist_ok=True)
    budget = FULL if arguments.full else QUICK if arguments.quick else Budget()
    began = time.perf_counter()
    for name, make in PARTS.items():
        if not arguments.parts or name in arguments.parts:
            make(budget, arguments.out)
            console.print(f"{name} done after {(time.perf_counter() - began) / 60.0:.1f} minutes", highlight=False)
    if arguments.out == RESULTS:
        fill(RESULTS)


if __name__ == "__main__":
    main()
