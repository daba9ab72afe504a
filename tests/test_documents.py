"""README, docs and notebooks: what they name exists, their commands compose, their style."""

from __future__ import annotations

import importlib
import pkgutil
import re
from pathlib import Path

import pytest

from documents import DOCUMENTS, REPOSITORY, code_blocks, commands, prose, read
from occdetr.cli import entry as cli
from occdetr.study.plan import read_study
from occdetr.study.results import block_lines, block_names, missing_runs, read_records

WIDTH = 120
MARKDOWN = [path for path in DOCUMENTS if path.suffix == ".md"]

#: Words of an earlier dialect, and what to write instead.
DIALECT = {
    r"mend(s|ed|ing)?": "fix",
    r"told": "reported",
    r"a person's|a person can": "the user",
    r"(the )?whole road|road end to end": "pipeline",
    r"the house": "structure",
    r"as loud as": "scaled like",
    r"stands? at": "is",
    r"fates?": "object errors",
    r"complaints?": "user errors",
    r"oracle('s)?": "upper bound",
    r"answers? for": "covers",
    r"ceilings?": "upper bound",
}

every_document = pytest.mark.parametrize(
    "path", DOCUMENTS, ids=lambda path: str(path.relative_to(REPOSITORY))
)
every_page = pytest.mark.parametrize(
    "path", MARKDOWN, ids=lambda path: str(path.relative_to(REPOSITORY))
)


def slug(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(path: Path) -> set[str]:
    return {slug(heading) for heading in re.findall(r"^#+ (.*)$", read(path), re.MULTILINE)}


@every_page
def test_lines_of_prose_are_short(path):
    """Tables may be wider, and a line that a single link or quoted word makes too long."""
    unbroken = re.compile(r' *\|.*|.*\]\(http.*| *"[^"]*"')
    long = [
        (number, line)
        for number, line in enumerate(read(path).splitlines(), 1)
        if len(line) > WIDTH and not unbroken.fullmatch(line)
    ]
    assert long == []


@every_document
def test_words_are_plain(path):
    text = " ".join(prose(read(path)).split())
    found = {
        match[0]: better
        for word, better in DIALECT.items()
        for match in re.finditer(rf"\b({word})\b", text, re.IGNORECASE)
    }
    assert found == {}


@every_document
def test_links_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", read(path)):
        if target.startswith("http"):
            continue
        place, _, anchor = target.partition("#")
        file = path if not place else (path.parent / place).resolve()
        assert file.exists(), target
        assert file.is_relative_to(REPOSITORY), target
        if anchor:
            assert anchor in anchors(file), target


@every_document
def test_files_that_are_named_exist(path):
    """Paths from the repository's root, and names of modules without their folder."""
    text = read(path)
    for name in re.findall(r"\b(?:src|conf|tests|docs|notebooks)/[\w./*-]*[\w*/]", text):
        if name.startswith("docs/results/") or "<" in text[text.index(name) :][: len(name) + 1]:
            continue  # what a study writes
        assert [*REPOSITORY.glob(name)], name
    for name in re.findall(r"`([\w/]+\.py)`", text):
        known = [*REPOSITORY.glob(name), *REPOSITORY.glob(f"src/occdetr/**/{name}")]
        assert known or name.startswith("my_"), name


@every_document
def test_modules_that_are_named_exist(path):
    for name in {*re.findall(r"(?<![/\w])occdetr(?:\.[A-Za-z_]\w*)+", read(path))}:
        assert pkgutil.resolve_name(name) is not None, name


def documented_commands():
    for path in DOCUMENTS:
        if path.name not in ("README.md", "extending.md"):  # they have tests of their own
            for entry, overrides in commands(read(path)):
                yield pytest.param(entry, overrides, id=f"{path.stem}-{entry}")


@pytest.mark.parametrize(("entry", "overrides"), documented_commands())
def test_commands_compose(entry, overrides):
    """The program exists and knows every setting; studies check theirs against their arms."""
    module = {"study": "study.plan", "results": "study.results"}.get(entry, entry)
    assert callable(importlib.import_module(f"occdetr.{module}").main)
    # visualize takes a bare list of frames
    own = [re.sub(r"^frames=([\w/, ]+)$", r"frames='\1'", override) for override in overrides]
    cli.compose_checked(entry, own)


@every_page
def test_commands_are_quoted_for_every_shell(path):
    """zsh takes [a,b] outside quotes for a pattern."""
    code = "".join(code for kind, code in code_blocks(read(path)) if kind == "sh")
    words = [re.sub(r"'[^']*'|\"[^\"]*\"", "", line) for line in code.splitlines()]
    assert not [line for line in words if re.search(r"=\[", line)]


def test_the_page_of_results_is_what_its_records_give():
    page = REPOSITORY / "docs" / "results.md"
    text = read(page)
    for name in block_names(text):
        plan = read_study(name.split("/")[-1])
        records = read_records(REPOSITORY / "docs" / "results" / name, plan)
        lines = block_lines(name.split("/")[-1], records, missing_runs(records, plan["seeds"]))
        shown = text.split(f"<!-- {name} -->\n")[1].split("\n<!-- end -->")[0]
        shown = re.sub(r"\n\n!\[.*\]\(images/.*\)$", "", shown)
        assert shown.splitlines() == lines, f"{name}: run python -m occdetr.study.results"
