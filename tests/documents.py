"""The Markdown documents of the repository and what is written in them, for the tests."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
DOCUMENTS = sorted(
    [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/**/*.md"), *REPOSITORY.glob("notebooks/*")]
)
FENCED = re.compile(r"^ *```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?:-m occdetr\.(?:study\.)?|(?<![\w./-])occdetr )(\w+)([^`\n]*)")


def read(path: Path) -> str:
    """The text of a document; of a notebook the text of its Markdown cells."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    cells = json.loads(text)["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def prose(text: str) -> str:
    """``text`` without its code, fenced or in a line."""
    return re.sub(r"`[^`]*`", "", FENCED.sub("", text))


def code_blocks(text: str) -> Iterator[tuple[str, str]]:
    """(language, code) of each fenced block."""
    for block in FENCED.finditer(text):
        indent = len(block[0]) - len(block[0].lstrip())
        yield block[1], "\n".join(line[indent:] for line in block[2].splitlines()) + "\n"


def commands(text: str) -> Iterator[tuple[str, list[str]]]:
    """(entry point, overrides) of each command, placeholders filled in; of a sweep its first job.

    A command may be wrapped: in a fenced block after a backslash, in a line of prose anywhere.
    """
    text = text.replace("\\\n", " ")
    text = re.sub(r"\$SLURM_\w+", "1", text)
    text = re.sub(r"(?<!`)`[^`]+`(?!`)", lambda code: code[0].replace("\n", " "), text)
    for entry, rest in COMMAND.findall(text):
        words = shlex.split(re.sub("[<>]", "", rest), comments=True)
        sweep = "-m" in words
        overrides = [word for word in words if re.match(r"[~+\w]*[\w./@]+=(?!\.\.\.$)|~", word)]
        yield entry, [_first(word) if sweep else word for word in overrides]


def _first(word: str) -> str:
    """A setting of a sweep with the first of its values, or the start of their interval."""
    return re.sub(r"=(?:tag\(log,)?interval\(", "=", word).split(",")[0]
