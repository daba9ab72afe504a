"""A table that is printed, and written into documents as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from rich.box import SIMPLE
from rich.table import Table


@dataclass
class Sheet:
    """Text in rows and columns; names on the left, numbers on the right. ``notes`` stand below."""

    title: str
    columns: Sequence[str]
    rows: list[Sequence[str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def table(self) -> Table:
        table = Table(title=self.title, box=SIMPLE, pad_edge=False, collapse_padding=True)
        for number, name in enumerate(self.columns):
            table.add_column(name, justify="right" if number else "left")
        for row in self.rows:
            table.add_row(*row)
        return table

    def markdown(self) -> str:
        """The title as a paragraph, the table, the notes."""
        lines = [self.title, "", _line(self.columns)]
        lines.append(_line(["---", *["---:"] * (len(self.columns) - 1)]))
        lines += map(_line, self.rows)
        notes = [text for note in self.notes for text in ("", note)]
        return "\n".join([*lines, *notes]) + "\n"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
