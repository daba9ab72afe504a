"""CITATION.cff: the software of this version, and the paper whose method it is."""

from __future__ import annotations

import re

import pytest
import yaml

import occdetr
from documents import REPOSITORY, read

FILE = REPOSITORY / "CITATION.cff"


@pytest.fixture
def citation():
    return yaml.safe_load(FILE.read_text(encoding="utf-8"))


def test_it_has_what_the_format_requires_and_this_version(citation):
    required = {"cff-version", "message", "title", "authors"}
    assert required < citation.keys()
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert str(citation["version"]) == occdetr.__version__
    assert citation["license"] == "Apache-2.0"


def test_it_asks_to_cite_the_paper(citation):
    paper = citation["preferred-citation"]
    assert {"type", "title", "authors"} < paper.keys()
    authors = [f"{author['given-names']} {author['family-names']}" for author in paper["authors"]]
    assert authors == ["Yupeng Jia", "Jie He", "Runze Chen", "Fang Zhao", "Haiyong Luo"]
    (link,) = set(re.findall(r"https://arxiv\.org/abs/[\d.]+", read(REPOSITORY / "README.md")))
    assert paper["url"] == link
    (preprint,) = paper["identifiers"]
    assert preprint["value"].endswith(link.rpartition("/")[2])
