"""Multi-scale bilinear sampling and its gradients on GPUs, in Triton.

A program works on one head of one image and a tile of queries; channels are padded to a power of
two. The gradient of the values is summed by atomic additions, in no fixed order. Sizes of the maps
are constants of the compiled code, so that nothing is copied to the device at a call.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import torch
import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]
from torch import Tensor

TILE = 32  # queries of a program


def forward(value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor) -> Tensor:
    """See ``operators.sample``."""
    batch, _, heads, channels = value.shape
    output = value.new_empty(batch, locations.shape[1], heads * channels)
    inputs = [t.contiguous() for t in (value, locations, weights)]
    if output.numel():
        launch = _forward[_programs(locations)]  # pyright: ignore[reportIndexIssue]
        launch(*inputs, output, *_sizes(value, locations, shapes))
    return output


def backward(
    gradient: Tensor, value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See ``operators.sample_backward``."""
    inputs = [t.contiguous() for t in (gradient, value, locations, weights)]
    to_value = torch.zeros(value.shape, dtype=locations.dtype, device=value.device)
    results = to_value, torch.empty_like(inputs[2]), torch.empty_like(inputs[3])
    if gradient.numel():
        launch = _backward[_programs(locations)]  # pyright: ignore[reportIndexIssue]
        launch(*inputs, *results, *_sizes(value, locations, shapes))
    return to_value.to(value.dtype), results[1], results[2]


def _programs(locations: Tensor) -> tuple[int, int]:
    batch, queries, _, heads = locations.shape[:4]
    return triton.cdiv(queries, TILE), batch * heads


def _sizes(value: Tensor, locations: Tensor, shapes: Sequence[int]) -> tuple[object, ...]:
    """The last arguments of both kernels."""
    _, tokens, heads, channels = value.shape
    queries, points = locations.shape[1], locations.shape[5]
    padded = triton.next_power_of_2(channels)
    return tokens, queries, heads, channels, tuple(shapes), len(shapes) // 2, points, TILE, padded


@triton.jit
@no_type_check
def _place(location, SIZE: tl.constexpr):
    """The cell before a normalised location, the fraction of the way to the next, and whether one
    of the two is in the map (then the first is at least -1)."""
    place = ((2.0 * location - 1.0) + 1.0) * (SIZE * 0.5) - 0.5
    near = (place >= -1.0) & (place < SIZE)
    floor = tl.floor(tl.where(near, place, 0.0))
    return floor.to(tl.int32), place - floor, near


@triton.jit
@no_type_check
def _forward(
    value,
    locations,
    weights,
    output,
    tokens,
    queries,
    heads,
    channels,
    SHAPES: tl.constexpr,
    LEVELS: tl.constexpr,
    POINTS: tl.constexpr,
    QUERIES: tl.constexpr,
    CHANNELS: tl.constexpr,
):
    query = tl.program_id(0) * QUERIES + tl.arange(0, QUERIES)
    batch, head = (tl.program_id(1) // heads).to(tl.int64), tl.program_id(1) % heads
    channel = tl.arange(0, CHANNELS)
    asked, real = query < queries, channel < channels
    row = (batch * queries + query) * heads + head
    row_x = (batch * queries + query) * 2 * heads + head  # of the locations
    plane = value + (batch * tokens * heads + head) * channels
    total = tl.zeros((QUERIES, CHANNELS), dtype=locations.dtype.element_ty)
    first_token = 0
    for level in tl.static_range(LEVELS):
        ROWS: tl.constexpr = SHAPES[2 * level]
        COLUMNS: tl.constexpr = SHAPES[2 * level + 1]
        for point in tl.static_range(POINTS):
            index = (row * LEVELS + level) * POINTS + point
            at_x = (row_x * LEVELS + level) * POINTS + point
            at_y = at_x + heads * LEVELS * POINTS
            x = tl.load(locations + at_x, mask=asked, other=0.0)
            y = tl.load(locations + at_y, mask=asked, other=0.0)
            weight = tl.load(weights + index, mask=asked, other=0.0)
            total += ((x + y + weight) * 0.0)[:, None]  # NaN if one of them is not finite
            left, across, near_x = _place(x, COLUMNS)
            upper, down, near_y = _place(y, ROWS)
            for corner in tl.static_range(4):
                i, j = upper + corner // 2, left + corner % 2
                share_y = down if corner // 2 == 1 else 1.0 - down
                share_x = across if corner % 2 == 1 else 1.0 - across
                inside = asked & near_x & near_y & (i >= 0) & (i < ROWS) & (j >= 0) & (j < COLUMNS)
                share = tl.where(inside, weight * share_y * share_x, 0.0)
                token = (first_token + i * COLUMNS + j) * heads * channels
                cells = plane + token[:, None] + channel[None, :]
                found = tl.load(cells, mask=inside[:, None] & real[None, :], other=0.0)
                total += share[:, None] * found.to(total.dtype)
        first_token += ROWS * COLUMNS
    place = output + row[:, None] * channels + channel[None, :]
    tl.store(place, total.to(output.dtype.element_ty), mask=asked[:, None] & real[None, :])


@triton.jit
@no_type_check
def _backward(
    gradient,
    value,
    locations,
    weights,
    to_value,
    to_locations,
    to_weights,
    tokens,
    queries,
    heads,
    channels,
    SHAPES: tl.constexpr,
    LEVELS: tl.constexpr,
    POINTS: tl.constexpr,
    QUERIES: tl.constexpr,
    CHANNELS: tl.constexpr,
):
    query = tl.program_id(0) * QUERIES + tl.arange(0, QUERIES)
    batch, head = (tl.program_id(1) // heads).to(tl.int64), tl.program_id(1) % heads
    channel = tl.arange(0, CHANNELS)
    asked, real = query < queries, channel < channels
    row = (batch * queries + query) * heads + head
    row_x = (batch * queries + query) * 2 * heads + head  # of the locations
    plane = (batch * tokens * heads + head) * channels
    place = gradient + row[:, None] * channels + channel[None, :]
    given = tl.load(place, mask=asked[:, None] & real[None, :], other=0.0)
    given = given.to(locations.dtype.element_ty)
    first_token = 0
    for level in tl.static_range(LEVELS):
        ROWS: tl.constexpr = SHAPES[2 * level]
        COLUMNS: tl.constexpr = SHAPES[2 * level + 1]
        for point in tl.static_range(POINTS):
            index = (row * LEVELS + level) * POINTS + point
            at_x = (row_x * LEVELS + level) * POINTS + point
            at_y = at_x + heads * LEVELS * POINTS
            x = tl.load(locations + at_x, mask=asked, other=0.0)
            y = tl.load(locations + at_y, mask=asked, other=0.0)
            weight = tl.load(weights + index, mask=asked, other=0.0)
            left, across, near_x = _place(x, COLUMNS)
            upper, down, near_y = _place(y, ROWS)
            along_weight = (x + y) * 0.0  # NaN if one of them is not finite
            along_x = along_weight
            along_y = along_weight
            for corner in tl.static_range(4):
                i, j = upper + corner // 2, left + corner % 2
                share_y = down if corner // 2 == 1 else 1.0 - down
                share_x = across if corner % 2 == 1 else 1.0 - across
                inside = asked & near_x & near_y & (i >= 0) & (i < ROWS) & (j >= 0) & (j < COLUMNS)
                share_y = tl.where(inside, share_y, 0.0)
                share_x = tl.where(inside, share_x, 0.0)
                token = (first_token + i * COLUMNS + j) * heads * channels
                cells = plane + token[:, None] + channel[None, :]
                mask = inside[:, None] & real[None, :]
                found = tl.load(value + cells, mask=mask, other=0.0).to(given.dtype)
                product = tl.sum(found * given, 1)
                added = (weight * share_y * share_x)[:, None] * given
                tl.atomic_add(to_value + cells, added, mask=mask)
                along_weight += share_y * share_x * product
                along_x += share_y * product * (2 * (corner % 2) - 1)
                along_y += share_x * product * (2 * (corner // 2) - 1)
            tl.store(to_weights + index, along_weight, mask=asked)
            tl.store(to_locations + at_x, along_x * weight * COLUMNS, mask=asked)
            tl.store(to_locations + at_y, along_y * weight * ROWS, mask=asked)
        first_token += ROWS * COLUMNS
