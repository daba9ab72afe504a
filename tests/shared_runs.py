"""A dataset, trained runs and checkpoints, made once per session; tests only read them."""

import pytest
import torch

from occdetr.streets.moment import Camera
from occdetr.streets.writer import write_streets
from programs import IMAGE_SIZE, SHORT, STREETS, newest, program


@pytest.fixture(scope="session")
def streets(tmp_path_factory):
    """The folder of a dataset of 2 + 3 streets."""
    root = tmp_path_factory.mktemp("streets")
    write_streets(root, 2, 3, camera=Camera(IMAGE_SIZE), progress=False)
    return root


@pytest.fixture(scope="session")
def runs(streets, tmp_path_factory):
    """The folder of the runs of a sweep over both stages, of one step each."""
    outputs = tmp_path_factory.mktemp("outputs")
    data = (*STREETS, f"data.root={streets}", f"outputs={outputs}")
    assert program("train", "-m", "stage=pretrain,full", *SHORT, *data) == 0
    return outputs


@pytest.fixture(scope="session")
def checkpoint(runs):
    """The checkpoint of full training."""
    return newest(runs, "full/*/last.ckpt")


@pytest.fixture(scope="session")
def varied_checkpoint(checkpoint, tmp_path_factory):
    """The same with random heads: it predicts every class somewhere, and objects everywhere."""
    raw = torch.load(checkpoint, weights_only=True)
    generator = torch.Generator().manual_seed(0)
    for name, value in raw["state_dict"].items():
        if name.startswith("model.mask_head") and value.ndim > 1:
            value += torch.randn(value.shape, generator=generator) * value.std() * 4
        if "class_heads" in name:
            value += torch.randn(value.shape, generator=generator) * 0.5
            value += 3.0 * name.endswith("bias")
    path = tmp_path_factory.mktemp("varied") / "varied.ckpt"
    torch.save(raw, path)
    return path
