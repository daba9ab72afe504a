"""Batches in one block of shared memory."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from model_factory import small_batch
from occdetr.data.transport import share_batches
from occdetr.structures import SceneBatch


def tensors_of(value: object) -> list[Tensor]:
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, list):
        return [tensor for item in value for tensor in tensors_of(item)]
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return [tensor for f in fields for tensor in tensors_of(getattr(value, f.name))]
    return []


@pytest.mark.parametrize("labelled", [True, False])
def test_a_batch_arrives_as_it_was_sent(labelled: bool) -> None:
    """Objects, none and no labels; strided and small tensors."""
    sent = [small_batch(2), small_batch(1, objects=False)]
    sent[0].images = sent[0].images.transpose(2, 3).contiguous().transpose(2, 3)
    if not labelled:
        sent = [dataclasses.replace(batch, labels=None, targets=None) for batch in sent]
    loader = DataLoader(
        sent,  # pyright: ignore[reportArgumentType]
        batch_size=None,
        num_workers=1,
        worker_init_fn=lambda worker: share_batches(),
    )
    for before, after in zip(sent, loader, strict=True):
        assert isinstance(after, SceneBatch)
        assert after.frame_ids == before.frame_ids
        assert after.camera.image_size == before.camera.image_size
        assert (after.labels is None) == (after.targets is None) == (not labelled)
        pairs = list(zip(tensors_of(before), tensors_of(after), strict=True))
        assert len(pairs) == (5 + 8 * len(before) if labelled else 4)
        for one, other in pairs:
            assert one.dtype == other.dtype
            assert torch.equal(one, other)
        assert len({t.untyped_storage().data_ptr() for t in tensors_of(after)}) == 1
