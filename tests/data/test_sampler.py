"""The frames of each rank."""

from __future__ import annotations

import itertools

import pytest

from occdetr.data.sampler import FrameSampler


@pytest.mark.parametrize("world_size", [1, 2, 3, 7])
def test_all_ranks_together_evaluate_every_frame_once(world_size: int) -> None:
    frames = range(5)
    parts = [list(FrameSampler(frames, False, 0, rank, world_size)) for rank in range(world_size)]
    assert sorted(itertools.chain(*parts)) == list(frames)
    for rank, part in enumerate(parts):
        assert len(FrameSampler(frames, False, 0, rank, world_size)) == len(part)


@pytest.mark.parametrize("world_size", [1, 2, 3])
def test_training_ranks_share_each_epoch_equally(world_size: int) -> None:
    frames = range(10)
    orders = []
    for epoch in range(2):
        samplers = [FrameSampler(frames, True, 3, rank, world_size) for rank in range(world_size)]
        for sampler in samplers:
            sampler.set_epoch(epoch)
        parts = [list(sampler) for sampler in samplers]
        assert {len(part) for part in parts} == {-(-10 // world_size)}
        drawn = list(itertools.chain(*parts))
        assert {index for _, index in drawn} == set(frames)
        assert {of for of, _ in drawn} == {epoch}
        orders.append([index for _, index in drawn])
    assert orders[0] != orders[1]


@pytest.mark.parametrize("world_size", [1, 2, 3])
@pytest.mark.parametrize("skipped", [4, 10])
def test_an_epoch_goes_on_where_it_was_left(skipped: int, world_size: int) -> None:
    """Also with another number of ranks than before: the order is one for all."""
    whole = FrameSampler(range(10), True, 3)
    whole.set_epoch(5)
    parts = [FrameSampler(range(10), True, 3, rank, world_size) for rank in range(world_size)]
    for part in parts:
        part.start_at(5, skipped)
        part.set_epoch(5)  # by Lightning, which does not know better
    rest = itertools.chain(*itertools.zip_longest(*parts))
    assert list(rest)[: 10 - skipped] == list(whole)[skipped:]
    for part in parts:
        assert len(part) == -(-10 // world_size)
        part.set_epoch(6)
        assert len(list(part)) == len(part)
