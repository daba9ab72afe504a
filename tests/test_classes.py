import re

import numpy as np
import pytest

from occdetr.classes import (
    BACKGROUND,
    CLASS_COLORS,
    CLASS_NAMES,
    FOREGROUND,
    IGNORE,
    LEARNING_MAP,
    LEARNING_MAP_INV,
    NUM_CLASSES,
    class_ids,
)
from occdetr.errors import InputError


def test_twenty_classes_and_a_label_outside_them():
    assert len(CLASS_NAMES) == len(set(CLASS_NAMES)) == NUM_CLASSES == 20
    assert CLASS_NAMES[0] == "empty"
    assert (CLASS_NAMES[1], CLASS_NAMES[9], CLASS_NAMES[19]) == ("car", "road", "traffic-sign")
    assert IGNORE not in range(NUM_CLASSES)


def test_colors_tell_the_classes_apart():
    assert CLASS_COLORS.dtype == np.uint8
    assert CLASS_COLORS.shape == (NUM_CLASSES, 3)
    assert len(np.unique(CLASS_COLORS, axis=0)) == NUM_CLASSES
    assert CLASS_COLORS[class_ids(["vegetation"])[0]].tolist() == [0, 175, 0]


def test_foreground_and_background_partition_the_semantic_classes():
    assert len(FOREGROUND) == 10
    assert len(BACKGROUND) == 9
    assert sorted(FOREGROUND + BACKGROUND) == sorted(CLASS_NAMES[1:])


def test_learning_map_inverse_is_a_right_inverse():
    assert sorted(LEARNING_MAP_INV) == list(range(NUM_CLASSES))
    assert {c: LEARNING_MAP[raw] for c, raw in LEARNING_MAP_INV.items()} == {
        c: c for c in range(NUM_CLASSES)
    }
    assert set(LEARNING_MAP.values()) == set(range(NUM_CLASSES))


def test_learning_map_folds_moving_and_rare_ids():
    assert len(LEARNING_MAP) == 34
    names = {raw: CLASS_NAMES[c] for raw, c in LEARNING_MAP.items()}
    assert (names[252], names[254], names[258]) == ("car", "person", "truck")
    assert {names[raw] for raw in (13, 16, 20, 256, 257, 259)} == {"other-vehicle"}
    assert names[60] == "road"
    assert {raw for raw, c in LEARNING_MAP.items() if c == 0} == {0, 1, 52, 99}


def test_class_ids_keep_the_order():
    assert class_ids(["pole", "car"]) == (18, 1)
    assert class_ids([]) == ()
    assert class_ids(FOREGROUND) == (1, 2, 3, 4, 5, 6, 7, 8, 18, 19)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["car", "tram"], "unknown class name 'tram'"),
        (["empty"], "unknown class name 'empty'"),
        (["car", "pole", "car"], "'car' is listed twice"),
    ],
)
def test_class_ids_refuse_what_is_no_class(names, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        class_ids(names)
    assert "\n" not in str(caught.value)
