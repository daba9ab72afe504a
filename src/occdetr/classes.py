"""The 20 classes of SemanticKITTI's scene completion: names, colours, raw ids, partitions."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from occdetr.errors import InputError

#: A label that is not evaluated (unknown, or a raw class outside the 20).
IGNORE = 255

_NAMES_AND_COLORS: tuple[tuple[str, tuple[int, int, int]], ...] = (
    ("empty", (0, 0, 0)),
    ("car", (100, 150, 245)),
    ("bicycle", (100, 230, 245)),
    ("motorcycle", (30, 60, 150)),
    ("truck", (80, 30, 180)),
    ("other-vehicle", (100, 80, 250)),
    ("person", (255, 30, 30)),
    ("bicyclist", (255, 40, 200)),
    ("motorcyclist", (150, 30, 90)),
    ("road", (255, 0, 255)),
    ("parking", (255, 150, 255)),
    ("sidewalk", (75, 0, 75)),
    ("other-ground", (175, 0, 75)),
    ("building", (255, 200, 0)),
    ("fence", (255, 120, 50)),
    ("vegetation", (0, 175, 0)),
    ("trunk", (135, 60, 0)),
    ("terrain", (150, 240, 80)),
    ("pole", (255, 240, 150)),
    ("traffic-sign", (255, 0, 0)),
)

#: Names by class id; 0 is ``empty``.
CLASS_NAMES: tuple[str, ...] = tuple(name for name, _ in _NAMES_AND_COLORS)

#: RGB of each class id, uint8 [20, 3]; the colours of the paper (and of SemanticKITTI).
CLASS_COLORS: np.ndarray = np.array([color for _, color in _NAMES_AND_COLORS], dtype=np.uint8)

NUM_CLASSES = len(CLASS_NAMES)

#: The paper's objects (Section III) ...
FOREGROUND: tuple[str, ...] = (
    *("car", "bicycle", "motorcycle", "truck", "other-vehicle"),
    *("person", "bicyclist", "motorcyclist", "pole", "traffic-sign"),
)

#: ... and its surfaces.
BACKGROUND: tuple[str, ...] = (
    *("road", "parking", "sidewalk", "other-ground", "building"),
    *("fence", "vegetation", "trunk", "terrain"),
)

#: Raw id in a ``.label`` file -> class id (``learning_map`` of semantic-kitti.yaml). Among voxels
#: only raw 0 is empty: any other raw id that maps to 0 is not evaluated.
LEARNING_MAP: dict[int, int] = {
    0: 0,  # unlabeled; among voxels: empty
    1: 0,  # outlier
    10: 1,  # car
    11: 2,  # bicycle
    13: 5,  # bus
    15: 3,  # motorcycle
    16: 5,  # on-rails
    18: 4,  # truck
    20: 5,  # other-vehicle
    30: 6,  # person
    31: 7,  # bicyclist
    32: 8,  # motorcyclist
    40: 9,  # road
    44: 10,  # parking
    48: 11,  # sidewalk
    49: 12,  # other-ground
    50: 13,  # building
    51: 14,  # fence
    52: 0,  # other-structure
    60: 9,  # lane-marking
    70: 15,  # vegetation
    71: 16,  # trunk
    72: 17,  # terrain
    80: 18,  # pole
    81: 19,  # traffic-sign
    99: 0,  # other-object
    252: 1,  # moving-car
    253: 7,  # moving-bicyclist
    254: 6,  # moving-person
    255: 8,  # moving-motorcyclist
    256: 5,  # moving-on-rails
    257: 5,  # moving-bus
    258: 4,  # moving-truck
    259: 5,  # moving-other-vehicle
}

#: Class id -> the raw id that a prediction file holds (``learning_map_inv``).
LEARNING_MAP_INV: dict[int, int] = {
    **{0: 0, 1: 10, 2: 11, 3: 15, 4: 18, 5: 20, 6: 30, 7: 31, 8: 32, 9: 40},
    **{10: 44, 11: 48, 12: 49, 13: 50, 14: 51, 15: 70, 16: 71, 17: 72, 18: 80, 19: 81},
}


def class_ids(names: Iterable[str]) -> tuple[int, ...]:
    """Class ids (1-19) of semantic class names, in the order given.

    Raises ``InputError`` on a name that is no semantic class (``empty`` is none) or comes twice.
    """
    names = tuple(names)
    for name in names:
        if name not in CLASS_NAMES[1:]:
            known = ", ".join(CLASS_NAMES[1:])
            raise InputError(f"unknown class name {name!r}: use names of {known}")
        if names.count(name) > 1:
            raise InputError(f"class name {name!r} is listed twice in {', '.join(names)}")
    return tuple(CLASS_NAMES.index(name) for name in names)


def check_classes(setting: str, classes: Iterable[int]) -> None:
    """Raises ``InputError`` on ids that are no semantic class, and on one that comes twice."""
    ids = [int(each) for each in classes]
    if any(not 0 < each < NUM_CLASSES for each in ids):
        raise InputError(f"{setting}={ids}: give ids from 1 to {NUM_CLASSES - 1}")
    if len(set(ids)) < len(ids):
        raise InputError(f"{setting}={ids}: give each id once")
