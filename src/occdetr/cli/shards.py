"""A share of the work for each of several jobs: ``shard=3/16``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, TypeVar

from occdetr.errors import InputError

T = TypeVar("T")


def parse_shard(text: Any) -> tuple[int, int]:
    """``3/16`` as (3, 16): the third of 16 jobs. Raises ``InputError`` on other texts."""
    match = re.fullmatch(r"(\d+)/(\d+)", str(text))
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise InputError(f"shard={text}: give i/n, the i-th of n jobs, as in shard=3/16")
    return int(match[1]), int(match[2])


def share_of(items: Sequence[T], shard: Any) -> list[T]:
    """Every n-th item, from the i-th on; each is in the share of one of the n jobs.

    Raises ``InputError`` as ``parse_shard``.
    """
    index, count = parse_shard(shard)
    return list(items[index - 1 :: count])
