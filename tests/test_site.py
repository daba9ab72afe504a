"""The documentation as a site: its navigation, what its hooks make of Markdown, and its build."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterator

import pytest
import yaml

from documents import REPOSITORY, read

SETTINGS = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8"))


def load_hooks():
    (file,) = SETTINGS["hooks"]
    spec = importlib.util.spec_from_file_location("site_hooks", REPOSITORY / file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


hooks = load_hooks()


def pages(node) -> Iterator[str]:
    """The pages of a navigation, or of a part of it."""
    if isinstance(node, str):
        yield node
    for child in node.values() if isinstance(node, dict) else node * isinstance(node, list):
        yield from pages(child)


def test_the_navigation_names_every_page_once_and_no_other():
    """A new page of docs/ belongs into ``nav`` of mkdocs.yml."""
    named = [*pages(SETTINGS["nav"])]
    docs = REPOSITORY / SETTINGS["docs_dir"]
    written = [file.relative_to(docs).as_posix() for file in docs.rglob("*.md")]
    assert sorted(named) == sorted([*written, *hooks.ELSEWHERE])


def test_pages_that_lie_elsewhere_are_there_and_in_no_ones_way():
    for page, source in hooks.ELSEWHERE.items():
        assert (REPOSITORY / source).is_file()
        assert not (REPOSITORY / "docs" / page).exists()


def test_every_object_of_the_reference_is_described():
    """mkdocstrings leaves out what has no docstring."""
    import pkgutil

    for file in (REPOSITORY / "docs" / "api").glob("*.md"):
        names = re.findall(r"^::: (\S+)$", read(file), re.MULTILINE)
        assert names
        for name in names:
            assert pkgutil.resolve_name(name).__doc__, name


@pytest.mark.parametrize(
    ("page", "link", "expected"),
    [
        ("index.md", "[a](docs/results.md#demo)", "[a](results.md#demo)"),
        ("index.md", "![a](docs/images/demo.png)", "![a](images/demo.png)"),
        ("index.md", "[a](src/occdetr/released/tiny.md)", "[a](model-card.md)"),
        ("index.md", "[`a`](docs/log/README.md)", "[`a`](log/README.md)"),
        ("log/02-demo.md", "[a](../../README.md#demo)", "[a](../index.md#demo)"),
        ("log/02-demo.md", "[a](../results.md)", "[a](../results.md)"),
        ("model-card.md", "[a](../../../docs/results.md#demo)", "[a](results.md#demo)"),
        ("results.md", "[a](#demo) <x> [b](https://h/x.md)", "[a](#demo) <x> [b](https://h/x.md)"),
        ("results.md", "`a\nb` [c](log/README.md) `d`", "`a\nb` [c](log/README.md) `d`"),
        ("index.md", "`a\nb` [c](docs/paper.md) `d`", "`a\nb` [c](paper.md) `d`"),
        ("results.md", "see [the file](../src/occdetr/train.py)!", "see the file!"),
        ("results.md", "`a[0](../x)`\n```\na[0](../x)\n```", "`a[0](../x)`\n```\na[0](../x)\n```"),
    ],
)
def test_links_are_made_those_of_the_site(page, link, expected):
    assert hooks.site_links(link, page) == expected


def test_links_to_other_files_lead_to_the_repository_if_it_has_an_address():
    found = hooks.site_links("[a](../src/occdetr/train.py#L3)", "results.md", "https://h/o/r/")
    assert found == "[a](https://h/o/r/blob/main/src/occdetr/train.py#L3)"


def test_lists_are_indented_as_python_markdown_needs_them():
    given = """text
- one
  more

  ```sh
  - no item
    x
  ```

  1. inner
     rest
- two

end
"""
    expected = """text

- one
    more

    ```sh
    - no item
      x
    ```

    1. inner
        rest
- two

end
"""
    assert hooks.indent_lists(given) == expected


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    """All links, anchors and objects are found: ``make docs`` installs what it needs."""
    for package in ("mkdocs", "material", "mkdocstrings_handlers.python"):
        pytest.importorskip(package)
    command = ["mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(
        [sys.executable, "-m", *command], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    site = tmp_path / "site"
    text = (site / "index.html").read_text(encoding="utf-8")
    assert "<h1" in text
    assert 'href="model-card.html"' in text
    reference = (site / "api" / "use.html").read_text(encoding="utf-8")
    for name in ("occdetr.load", "occdetr.Camera", "occdetr.Result", "occdetr.Recording"):
        assert f'id="{name}"' in reference
    assert [*site.rglob("*.json")] == [site / "search" / "search_index.json"]  # no records
    outside = (
        r'(?:src|href)="https?://(?!arxiv|github|semver|keepachangelog|rerun)[^"]*\.(?:js|css)"'
    )
    assert not re.search(outside, text)  # nothing is loaded from elsewhere
