"""A dataset, trained runs, checkpoints and an evaluation that several tests read.

Each is made once: fixtures of the session's scope, which the workers of pytest-xdist share.
"""

import contextlib
import io
import os
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from occdetr.streets.settings import StreetSettings
from occdetr.streets.writer import write_streets
from programs import IMAGE_SIZE, SHORT, STREETS, newest, program


@contextlib.contextmanager
def made_once(tmp_path_factory, name):
    """The folder ``name``, and whether it is still to be filled: by one worker, others wait."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # of this session's workers
    folder, done = base / name, base / f"{name}.done"
    with FileLock(base / f"{name}.lock"):
        folder.mkdir(exist_ok=True)
        yield folder, not done.exists()
        done.touch()


@pytest.fixture(scope="session")
def streets(tmp_path_factory) -> Path:
    """The folder of a dataset of 2 + 3 streets."""
    with made_once(tmp_path_factory, "streets") as (root, missing):
        if missing:
            settings = StreetSettings(2, 3, street_image_size=IMAGE_SIZE)
            write_streets(root, settings, progress=False)
    return root


@pytest.fixture(scope="session")
def runs(streets, tmp_path_factory) -> Path:
    """The folder of the runs of a sweep over both stages, of one step each."""
    with made_once(tmp_path_factory, "runs") as (outputs, missing):
        if missing:
            data = (*STREETS, f"data.root={streets}", f"outputs={outputs}")
            assert program("train", "-m", "stage=pretrain,full", *SHORT, *data) == 0
    return outputs


@pytest.fixture(scope="session")
def checkpoint(runs) -> Path:
    """The checkpoint of full training."""
    return newest(runs, "full/*/last.ckpt")


@pytest.fixture(scope="session")
def varied_checkpoint(checkpoint, tmp_path_factory) -> Path:
    """The same with random heads: it predicts every class somewhere, and objects everywhere."""
    with made_once(tmp_path_factory, "varied") as (folder, missing):
        if missing:
            raw = torch.load(checkpoint, weights_only=True)
            randomize_heads(raw["state_dict"])
            torch.save(raw, folder / "varied.ckpt")
    return folder / "varied.ckpt"


def randomize_heads(state):
    generator = torch.Generator().manual_seed(0)
    for name, value in state.items():
        if name.startswith("model.mask_head") and value.ndim > 1:
            value += torch.randn(value.shape, generator=generator) * value.std() * 4
        if "class_heads" in name:
            value += torch.randn(value.shape, generator=generator) * 0.5
            value += 3.0 * name.endswith("bias")


@pytest.fixture(scope="session")
def evaluation(varied_checkpoint, tmp_path_factory) -> Path:
    """The folder of an evaluation of ``varied_checkpoint`` with its diagnosis and its predictions.

    What it printed is in ``output.txt``.
    """
    with made_once(tmp_path_factory, "evaluation") as (folder, missing):
        if missing:
            given = ("save_predictions=true", "diagnose=true", "pictures=2")
            given = (*given, f"hydra.run.dir={folder}")
            with contextlib.redirect_stdout(io.StringIO()) as out:
                code = program("evaluate", f"checkpoint={varied_checkpoint}", *given, "trainer=cpu")
            assert code == 0
            (folder / "output.txt").write_text(out.getvalue())
    return folder
