"""A table in both of its forms."""

import io

from rich.console import Console

from occdetr.benchmark.sheet import Sheet


def test_both_forms_hold_every_cell():
    sheet = Sheet("A title", ["", "ms"], [["backbone", "1.5"], ["whole", "2.0"]], ["A note."])
    assert sheet.markdown() == (
        "A title\n\n|  | ms |\n| --- | ---: |\n| backbone | 1.5 |\n| whole | 2.0 |\n\nA note.\n"
    )
    text = io.StringIO()
    Console(width=80, file=text).print(sheet.table())
    assert all(cell in text.getvalue() for cell in ("A title", "backbone", "1.5", "2.0"))
