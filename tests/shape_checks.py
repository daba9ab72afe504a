"""The checker that ``conftest.py`` puts on every function of the package."""

from collections.abc import Sequence

from beartype import BeartypeConf, BeartypeHintOverrides, beartype
from beartype.roar import BeartypeDecorHintPep673Exception

_CHECK = beartype(
    conf=BeartypeConf(
        is_pep484_tower=True,  # an int will do for a float
        hint_overrides=BeartypeHintOverrides(  # YAML has no tuples
            {tuple[int, int]: Sequence[int], tuple[int, ...]: Sequence[int]}
        ),
    )
)


def check_types(function):
    """Check arguments and results against their annotations."""
    try:
        return _CHECK(function)
    except BeartypeDecorHintPep673Exception:  # beartype takes Self in classes only
        return function
