"""Ranges of numbers, and the lines for what lies outside."""

import math

import pytest

from occdetr.errors import BELOW_ONE, COUNT, POSITIVE, SHARE, InputError, check_each, check_range


@pytest.mark.parametrize(
    ("limits", "inside", "outside", "words"),
    [
        (COUNT, [1, 10**9], [0, -1, math.inf, math.nan], "1 or more"),
        (POSITIVE, [1e-9], [0, -1, math.inf], "more than 0"),
        (SHARE, [0, 0.5, 1], [-0.1, 1.1, math.nan], "0 to 1"),
        (BELOW_ONE, [0, 0.999], [1, math.nan], "0 to below 1"),
    ],
)
def test_a_range_says_what_it_holds(limits, inside, outside, words):
    assert all(value in limits for value in inside)
    assert not any(value in limits for value in outside)
    assert str(limits) == words


def test_the_line_names_the_setting():
    with pytest.raises(InputError, match=r"^a\.b=0: give 1 or more$"):
        check_range("a.b", 0, COUNT)
    with pytest.raises(InputError, match=r"^a\.b\.c=2: give 0 to 1$"):
        check_each("a.b", {"c": 2}, SHARE)
    with pytest.raises(InputError, match=r"^a\.b=\[1, 0\]: give numbers of 1 or more$"):
        check_each("a.b", [1, 0], COUNT)
    check_range("a.b", None, COUNT)  # null, where the type allows it
