"""What all commands share: the program, what it says and where, and how it ends.

A command says a line, shows a table, or raises; whatever it raises becomes one line here, and an exit code.  What goes
to the screen goes to the log in the folder of results too, with the details of what nobody foresaw.
"""

import contextlib
import functools
import inspect
import io
import logging
import os
import platform
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from phytofit.cli.messages import at_command_line, of_usage
from phytofit.errors import PhytofitError
from phytofit.text import one_line

if TYPE_CHECKING:
    from phytofit.cloud import PointCloud

__all__ = [
    "Terminated",
    "app",
    "command",
    "complain",
    "end",
    "err",
    "out",
    "progress_line",
    "read_quietly",
    "remark",
    "results_in",
    "say",
    "show",
    "unforeseen",
]

LOG = logging.getLogger("phytofit")
LOG.addHandler(logging.NullHandler())
LOG.propagate = False
DETAILS = LOG.getChild("details")  # of faults, and warnings of libraries: for the log, and for --verbose
NOTHING_DONE = 2  # exit code; 0: all was measured; 1: some inputs failed, the others are done
INTERRUPTED, TERMINATED = 130, 143  # 128 and the signal's number, as shells have it
COMMANDS = ("demo", "fit", "run", "segment", "reconstruct", "simulate", "validate", "recipe")  # as the help lists them
LOG_WIDTH = 120  # columns of a table in the log


class Terminated(KeyboardInterrupt):
    """The process was asked to end (SIGTERM)."""


_asked_to_end: list[type[KeyboardInterrupt]] = []


def end(error: type[KeyboardInterrupt]) -> NoReturn:
    """End the command; where a library takes this for an error of its own, at the next line that is said."""
    _asked_to_end.append(error)
    raise error


class _Console(Console):
    """Falls silent where nobody reads any more (``| head``); the results are written nevertheless."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


out, err = _Console(), _Console(stderr=True)


class _Program(TyperGroup):
    """Says in one line what is wrong with the arguments, as it does with everything else."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*COMMANDS]

    def main(self, *arguments: Any, **named: Any) -> Any:
        standalone = named.pop("standalone_mode", True)
        try:
            code = super().main(*arguments, **(named | {"standalone_mode": False}))
        except typer.TyperException as error:
            complain(of_usage(error))
            code = NOTHING_DONE
        except OSError as error:  # where help can't be shown; commands say themselves what is wrong
            complain(unforeseen(error))
            code = NOTHING_DONE
        return sys.exit(code) if standalone else code


app = typer.Typer(
    cls=_Program,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        out.print(f"phytofit {version('phytofit')}", highlight=False)
        raise typer.Exit


@app.callback(invoke_without_command=True)
def program(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option("--version", metavar="", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Plant traits from 3D point clouds, by fitting parametric plant models.

    Start with: phytofit demo

    Measure a leaf on its piece of stem: phytofit fit leaf.ply --units cm

    Measure a whole plant: phytofit run plant.ply --units cm
    """
    if context.invoked_subcommand is None:
        print(context.get_help())


QuietOption = Annotated[
    bool,
    typer.Option(
        "--quiet", "-q", metavar="", help="Show nothing but errors; results and log are written all the same."
    ),
]
VerboseOption = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", metavar="", help="Show the warnings of libraries, and where in the code a fault arose."
    ),
]


def command(name: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add a function to the program, with --quiet and --verbose; whatever it raises is one line and an exit code."""

    def add(function: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(function)
        def told(*, quiet: bool, verbose: bool, **arguments: Any) -> None:
            out.quiet = quiet
            with _details(verbose), _ending():
                function(**arguments)

        signature = inspect.signature(function)
        shared = {"quiet": QuietOption, "verbose": VerboseOption}
        parameters = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=option)
            for name, option in shared.items()
        ]
        wide = signature.replace(parameters=[*signature.parameters.values(), *parameters])
        told.__dict__.update(__signature__=wide, __annotations__={**function.__annotations__, **shared})
        app.command(name, help=_paragraphs(function))(told)
        return function

    return add


def _paragraphs(function: Callable[..., None]) -> str:
    """The docstring, each paragraph in one line, which the terminal will break."""
    return re.sub(r"(?<=\S)\n(?=\S)", " ", inspect.cleandoc(function.__doc__ or "")).replace("[", r"\[")


@contextlib.contextmanager
def _details(verbose: bool) -> Iterator[None]:
    """Warnings and tracebacks go to the log, and if wished to the screen."""
    handler = logging.StreamHandler(err.file) if verbose else logging.NullHandler()
    DETAILS.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, category, *_: DETAILS.warning("%s: %s", category.__name__, message)
            yield
    finally:
        DETAILS.removeHandler(handler)


@contextlib.contextmanager
def results_in(folder: Path) -> Iterator[None]:
    """The folder of results is made ready; meanwhile all that is said is logged there."""
    from importlib.metadata import version

    from phytofit.io import prepare_folder
    from phytofit.io.log import open_log

    with open_log(prepare_folder(folder)), _ending():
        LOG.info("phytofit %s, Python %s, %s", version("phytofit"), platform.python_version(), platform.platform())
        LOG.info("phytofit %s", shlex.join(sys.argv[1:]))
        yield


@contextlib.contextmanager
def _ending() -> Iterator[None]:
    """Whatever is raised meanwhile is one line on the screen, and an exit code."""
    try:
        yield
    except PhytofitError as error:
        complain(error)
        raise typer.Exit(NOTHING_DONE) from None
    except KeyboardInterrupt as error:
        _asked_to_end.clear()
        complain("stopped; the results that were finished are kept")
        raise typer.Exit(TERMINATED if isinstance(error, Terminated) else INTERRUPTED) from None
    except typer.Exit:
        raise
    except Exception as error:
        complain(unforeseen(error))
        raise typer.Exit(NOTHING_DONE) from None


def unforeseen(error: Exception) -> str:
    """What to say of a fault of phytofit's own; its details are logged."""
    DETAILS.error("where it arose:", exc_info=error)
    if isinstance(error, OSError) and error.strerror:  # of what was given or is written to, not of phytofit
        return f"{error.filename or 'standard output'}: {error.strerror}; choose another file or folder, or make room"
    logs = [handler.baseFilename for handler in LOG.handlers if isinstance(handler, logging.FileHandler)]
    ours = [log for log in logs if Path(log).name == "phytofit.log"]
    where = f"details are in {ours[0]}" if ours else "--verbose shows details"
    return f"unexpected error: {type(error).__name__}: {error or 'no details'}; {where}"


def complain(error: Exception | str) -> None:
    """An error, in one line."""
    _line(err, "error: ", "bold red", at_command_line(error), logging.ERROR)


def remark(kind: str, text: str) -> None:
    """A note, which informs; a flag, or what to check, which says what to doubt; or what is poor, not to be used."""
    style = {"note": "", "poor": "bold red"}.get(kind, "bold yellow")
    _line(out, f"{kind}: ", style, at_command_line(text), logging.INFO)


def say(text: str) -> None:
    """A line."""
    _line(out, "", "", text, logging.INFO)


def show(table: Table) -> None:
    """A table."""
    out.print(table)
    if LOG.isEnabledFor(logging.INFO):
        plain = Console(file=io.StringIO(), width=LOG_WIDTH)
        plain.print(table)
        for line in plain.file.getvalue().rstrip().splitlines():  # type: ignore[attr-defined]
            LOG.info("%s", line.rstrip())


def progress_line(text: str) -> None:
    """How far the command is, where no bar can say so."""
    if err.is_terminal or out.quiet:
        LOG.info("%s", text)
    else:
        _line(err, "", "", text, logging.INFO)


def _line(console: Console, head: str, style: str, text: str, level: int) -> None:
    if _asked_to_end:
        raise _asked_to_end.pop()
    line = one_line(text)
    console.print(Text.assemble((head, style), line), soft_wrap=True)
    LOG.log(level, "%s%s", "" if level == logging.ERROR else head, line)


def read_quietly(path: Path, units: str | None, labels: str | None, **how: Any) -> "PointCloud":
    """The cloud in a file, whose warnings stand in its notes, which are printed."""
    from phytofit.cloud import read_cloud

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return read_cloud(path, units, label_property=labels, **how)
