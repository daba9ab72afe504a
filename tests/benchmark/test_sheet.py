"""A table in both of its forms."""

from rich.console import Console

from occdetr.benchmark.sheet import Sheet


def test_both_forms_hold_every_cell():
    sheet = Sheet("A title", ["", "ms"], [["backbone", "1.5"], ["whole", "2.0"]], ["A note."])
    assert sheet.markdown() == (
        "A title\n\n|  | ms |\n| --- | ---: |\n| backbone | 1.5 |\n| whole | 2.0 |\n\nA note.\n"
    )
    console = Console(width=80, record=True, quiet=True)
    console.print(sheet.table())
    text = console.export_text()
    assert all(cell in text for cell in ("A title", "backbone", "1.5", "2.0"))
