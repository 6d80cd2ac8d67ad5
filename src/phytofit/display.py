"""How results show themselves: a short table in a terminal, the same as HTML in a notebook."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from phytofit.text import one_line

__all__ = ["Shown", "Summary"]


@dataclass(frozen=True)
class Summary:
    """What is shown of a result: a title, a table with its columns' names, and remarks."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    remarks: Sequence[str] = ()


class Shown(ABC):
    """A result that shows itself by its summary."""

    @abstractmethod
    def summary(self) -> Summary:
        """What is worth seeing at first sight."""

    def __repr__(self) -> str:
        made = self.summary()
        lines = [[one_line(cell) for cell in line] for line in (made.columns, *made.rows)]
        widths = [max(len(line[i]) for line in lines) for i in range(len(made.columns))]
        table = ["  ".join(cell.ljust(n) for cell, n in zip(line, widths, strict=True)).rstrip() for line in lines]
        return "\n".join([one_line(made.title), *table, *map(one_line, made.remarks)])

    def _repr_html_(self) -> str:
        made = self.summary()

        def row(cells: Sequence[str], tag: str) -> str:
            return "<tr>" + "".join(f"<{tag}>{escape(one_line(cell))}</{tag}>" for cell in cells) + "</tr>"

        body = "".join(row(cells, "td") for cells in made.rows)
        remarks = "".join(f"<li>{escape(one_line(text))}</li>" for text in made.remarks)
        return (
            f"<p>{escape(one_line(made.title))}</p><table><thead>{row(made.columns, 'th')}</thead>"
            f"<tbody>{body}</tbody></table>" + (f"<ul>{remarks}</ul>" if remarks else "")
        )
