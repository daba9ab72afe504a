"""Which plain values fit an annotation."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import pytest

from occdetr.cli.hints import accepts, advice
from occdetr.models.slots import SlotSelection


@pytest.mark.parametrize(
    ("hint", "fits", "refused"),
    [
        (int, [0, -3], [1.0, True, "3", None, [1]]),
        (float, [0, 1.5, float("inf")], [float("nan"), False, "1.5", None]),
        (bool, [True], [1, "true", None]),
        (float | None, [None, 2], ["null"]),
        (int | float, [1, 1.5], [True]),
        (str | Path, ["a", 2024], [None, ["a"]]),
        (Literal["a", "b"] | None, ["a", None], ["c", 1]),
        (Sequence[int], [[], [1]], [[1, None], [1.5], 1, "12"]),
        (tuple[int, int], [[1, 2]], [[1], [1, 2, 3]]),
        (tuple[int, ...], [[], [1, 2, 3]], [["a"]]),
        (Mapping[str, float], [{}, {"a": 1}], [{"a": "x"}, [1], None]),
        (SlotSelection, [{"_target_": "x"}], [None, 5, []]),
        (Any, [None, 5, "x"], []),
    ],
)
def test_a_value_fits_an_annotation_as_it_is(hint, fits, refused):
    assert all(accepts(hint, value) for value in fits)
    assert not any(accepts(hint, value) for value in refused)


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        (int | None, "give a whole number, or null"),
        (Literal["a"] | Literal["b"], "choose one of a, b"),
        (int | float, "give a number"),
        (tuple[int, int], "give a list of 2 whole numbers"),
        (dict[str, float], "give names, each with a number"),
    ],
)
def test_the_advice_says_what_fits(hint, words):
    assert advice(hint) == words
