"""Whether an exported network gives what the network itself gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from occdetr.export.network import OBJECTS

#: Least shares of voxels with equal class: of all, and of those that are occupied in either grid.
#: A street is empty to nine tenths, so the first alone would let whole objects be missing.
LEAST, LEAST_OCCUPIED = 0.999, 0.99
#: Least share of objects that agree: equal class, and differences below these. Few may not: queries
#: whose scores nearly tie are selected in one of the two networks alone.
LEAST_OBJECTS = 0.9
TOLERANCES = {"boxes_xyxy": 2.0, "boxes3d": 0.5, "scores": 0.05}  # pixels, metres


@dataclass(frozen=True)
class Parity:
    """The differences of two outputs.

    ``voxels`` and ``occupied_voxels`` are shares of voxels with equal class. ``boxes_xyxy``
    (pixels), ``boxes3d`` (metres) and ``scores`` are the largest absolute differences, and
    ``classes`` is the share of objects with equal class; empty without objects. ``agreeing`` is the
    share of objects that agree (``TOLERANCES``).
    """

    voxels: float
    occupied_voxels: float
    objects: dict[str, float]
    agreeing: float = 1.0

    @property
    def finite(self) -> bool:
        """Whether all boxes and scores are finite."""
        return all(value != float("inf") for value in self.objects.values())

    @property
    def failure(self) -> str | None:
        """Why the exported network must not be used, if so."""
        if self.voxels < LEAST:
            return f"{self.voxels:.3%} of the voxels have equal class, less than {LEAST:.1%}"
        if self.occupied_voxels < LEAST_OCCUPIED:
            shares = f"{self.occupied_voxels:.2%} of the occupied voxels have equal class"
            return f"{shares}, less than {LEAST_OCCUPIED:.0%}"
        if not self.finite:
            return "its boxes or scores are not finite"
        if self.agreeing < LEAST_OBJECTS:
            return f"{self.agreeing:.0%} of the objects agree, less than {LEAST_OBJECTS:.0%}"
        return None

    def __str__(self) -> str:
        text = f"{self.voxels:.4%} of the voxels have equal class ({self.occupied_voxels:.3%} of "
        text += "the occupied)"
        if self.objects:
            found = self.objects
            text += (
                f"; largest difference: 2D boxes {found['boxes_xyxy']:.1e} pixels, "
                f"3D boxes {found['boxes3d']:.1e} m, scores {found['scores']:.1e}; "
                f"{found['classes']:.2%} of the objects have equal class"
            )
        return text


def compare(expected: Mapping[str, Tensor], found: Mapping[str, Tensor]) -> Parity:
    """``expected`` and ``found`` are outputs by name, of one image."""
    own, other = expected["grid"].cpu(), found["grid"].cpu()
    equal, occupied = own == other, (own != 0) | (other != 0)
    shared = float(equal[occupied].float().mean()) if occupied.any() else 1.0
    with_objects = OBJECTS[0] in expected
    objects, agreeing = _compare_objects(expected, found) if with_objects else ({}, 1.0)
    return Parity(float(equal.float().mean()), shared, objects, agreeing)


def _compare_objects(
    expected: Mapping[str, Tensor], found: Mapping[str, Tensor]
) -> tuple[dict[str, float], float]:
    """The differences of objects, and the share of those that agree.

    They are paired first: those whose selection scores nearly tie may swap places.
    """
    own, other = ({k: x[k][0].cpu().double() for k in OBJECTS} for x in (expected, found))
    differing = ("boxes_xyxy", "boxes3d", "scores")
    if not all(torch.isfinite(other[name]).all() for name in differing):
        return {**dict.fromkeys(differing, float("inf")), "classes": 0.0}, 0.0
    rows = [
        torch.cat([x["boxes_xyxy"], x["boxes3d"], x["scores"][:, None]], 1) for x in (own, other)
    ]
    left, right = map(torch.from_numpy, linear_sum_assignment(torch.cdist(*rows, p=1)))
    pairs = {name: (own[name][left], other[name][right]) for name in OBJECTS}
    distances = {name: (pairs[name][0] - pairs[name][1]).abs() for name in differing}
    agree = equal = pairs["classes"][0] == pairs["classes"][1]
    for name, distance in distances.items():
        agree = agree & (distance.reshape(len(agree), -1) < TOLERANCES[name]).all(1)
    largest = {name: float(distance.max()) for name, distance in distances.items()}
    classes, agreeing = (float(share.double().mean()) for share in (equal, agree))
    return {**largest, "classes": classes}, agreeing
