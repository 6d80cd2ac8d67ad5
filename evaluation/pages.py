"""The tables of ``evaluation/results`` put where pages show them: between ``<!-- NAME -->`` and ``<!-- end -->``."""

import re
from pathlib import Path

from evaluation.settings import ROOT

PAGES = (ROOT / "docs" / "accuracy.md", ROOT / "docs" / "evaluation.md")


def fill(out: Path, pages: tuple[Path, ...] = PAGES) -> None:
    for page in pages:
        page.write_text(filled(page.read_text(encoding="utf-8"), out), encoding="utf-8")


def filled(text: str, out: Path) -> str:
    """The text with each marked place holding the Markdown file of its name, if there is one."""

    def put(match: re.Match[str]) -> str:
        file = out / f"{match[1]}.md"
        if not file.is_file():  # it rests on data that are absent
            return match[0]
        return f"<!-- {match[1]} -->\n{file.read_text(encoding='utf-8').strip()}\n<!-- end -->"

    return re.sub(r"<!-- (\w+) -->\n.*?<!-- end -->", put, text, flags=re.DOTALL)
