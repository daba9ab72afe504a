"""Hooks of MkDocs (``make docs``): the repository's Markdown files as pages of one site.

The files are written for GitHub. README, changelog and model card lie outside of ``docs/`` and
become pages; links between files are those of the repository; anchors and lists follow GitHub's
rules where Python-Markdown has others.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]
#: Pages whose file is not in ``docs/``, and that file.
ELSEWHERE = {
    "index.md": "README.md",
    "model-card.md": "src/occdetr/released/tiny.md",
    "changelog.md": "CHANGELOG.md",
}
LIST_INDENT = 4  # columns of a list's contents for Python-Markdown

_CODE = r"`(?:[^`\n]|\n(?!\n))+`"
_LINK = re.compile(_CODE + r"|(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^)\s]+)\)")
_MARKER = re.compile(r" *([-*+]|\d+\.) +(?=\S)")


# ---------------------------------------------------------------------- what MkDocs calls


def on_config(config: Any) -> Any:
    """Headings get GitHub's anchors."""
    config["mdx_configs"].setdefault("toc", {})["slugify"] = slug
    return config


def on_files(files: Any, config: Any) -> Any:
    """The pages that lie elsewhere."""
    from mkdocs.structure.files import File

    for page, source in ELSEWHERE.items():
        files.append(File.generated(config, page, abs_src_path=str(REPOSITORY / source)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """A page as Python-Markdown takes it."""
    return indent_lists(site_links(markdown, page.file.src_uri, config["repo_url"]))


# ---------------------------------------------------------------------- from GitHub's Markdown


def slug(heading: str, separator: str = "-") -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", separator)


def site_links(markdown: str, page: str, repository_url: str | None = None) -> str:
    """The links of a page such as ``log/README.md`` made those of the site; code is left alone.

    A link to what is no part of the site leads to the repository if its address is known, and
    becomes plain text otherwise.
    """

    def replaced(match: re.Match[str]) -> str:
        image, text, target = match.groups()
        if target is None or re.match(r"[a-z]+:|#", target):  # code, or no file
            return match[0]
        place, mark, anchor = target.partition("#")
        file = posixpath.normpath(posixpath.join(posixpath.dirname(source_of(page)), place))
        inside = page_of(file)
        if inside is not None:
            found = posixpath.relpath(inside, posixpath.dirname(page) or ".")
        elif repository_url:
            found = f"{repository_url.rstrip('/')}/blob/main/{file}"
        else:
            return text
        return f"{image}[{text}]({found}{mark}{anchor})"

    blocks = re.split(r"(^ *```.*?^ *```$)", markdown, flags=re.MULTILINE | re.DOTALL)
    return "".join(
        block if number % 2 else _LINK.sub(replaced, block) for number, block in enumerate(blocks)
    )


def source_of(page: str) -> str:
    """The file of a page, from the repository's root."""
    return ELSEWHERE.get(page, f"docs/{page}")


def page_of(file: str) -> str | None:
    """The page, or the other file of the site, that a file of the repository is; None: none."""
    pages = {source: page for page, source in ELSEWHERE.items()}
    if file in pages:
        return pages[file]
    if file.startswith("docs/") and (REPOSITORY / file).is_file():
        return file.removeprefix("docs/")
    return None


def indent_lists(markdown: str) -> str:
    """Lists with their contents four columns in, and a blank line before them.

    GitHub takes contents that are as far in as the item's text; Python-Markdown does not.
    """
    result: list[str] = []
    columns: list[int] = []  # where the contents of the open items begin
    for line, is_code in _lines(markdown):
        text = line.lstrip(" ")
        column = len(line) - len(text)
        while text and not is_code and columns and column < columns[-1]:
            columns.pop()
        marker = None if is_code else _MARKER.match(line)
        after_text = result and result[-1].strip() and not _MARKER.match(result[-1])
        if marker and not columns and after_text and result[-1][0] != " ":
            result.append("")
        inner = max(column - (columns[-1] if columns else 0), 0)
        result.append(" " * (LIST_INDENT * len(columns) + inner) + text if text else "")
        if marker:
            columns.append(marker.end())
    return "\n".join(result)


def _lines(markdown: str) -> Iterator[tuple[str, bool]]:
    """Every line, and whether it is inside of a fenced block of code."""
    fenced = False
    for line in markdown.split("\n"):
        fence = line.lstrip().startswith("```")
        yield line, fenced
        if fence:
            fenced = not fenced
