"""``predict submission=...``: the hidden test of SemanticKITTI."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from occdetr.cli import entry as cli
from occdetr.cli.checkpoint_data import checkpoint_data
from occdetr.errors import InputError
from occdetr.evaluation.submission import (
    LABEL_BYTES,
    label_name,
    wanted_frames,
    write_submission,
)
from occdetr.files import remove_temporary_files, write_json
from occdetr.models.compilation import compile_network
from occdetr.training.callbacks import PredictionWriter
from occdetr.training.checkpoint import UNTRAINED_GRIDS
from occdetr.training.stage import StageModule
from occdetr.training.trainer import is_main_process, make_trainer, run


def submit(config: DictConfig) -> None:
    """Predict the test split of ``data`` and write ``submission``, a zip file for the hidden test.

    The predictions lie in a folder beside it, so that the same command goes on where it stopped.
    """
    file = Path(str(config.submission)).expanduser()
    if file.suffix != ".zip":
        raise InputError(f"submission={file}: the name must end with .zip")
    if config.images is not None or config.get("data") is None:
        raise InputError(
            "submission: predicts a data set: give data=semantickitti data.root=<root>, and no "
            "images"
        )
    for text in HydraConfig.get().overrides.task:
        if re.match(
            r"[+~]*(calib|camera|files|video|fps|frame_step|viewer|device|score_threshold"
            r"|merge_doubles)\b",
            text,
        ):
            raise InputError(f"{text}: only for images: leave it out")
    module = StageModule.load_from_checkpoint(config.checkpoint, allow=cli.plain(config.allow))
    datamodule = checkpoint_data(config, module.hparams, {"batch_size": config.batch_size})
    datamodule.prepare_data()
    frames, folder = datamodule.frames("test"), file.with_suffix("")
    check_frames([frame.id for frame in frames], Path(datamodule.root))
    continue_folder(folder, submission_identity(config, module))
    left = [frame for frame in frames if not is_predicted(folder / label_name(frame.id))]
    trainer = make_trainer(
        cli.build(config.trainer, _partial_=True), cli.run_folder(), [PredictionWriter(folder)]
    )
    if is_main_process():
        print(f"{config.checkpoint} on {datamodule.summary('test')}", flush=True)
        if module.stage == "pretrain":
            print(f"note: {config.checkpoint}: {UNTRAINED_GRIDS}", flush=True)
        if len(left) < len(frames):
            done = len(frames) - len(left)
            print(f"{done} of {len(frames)} are in {folder}: going on", flush=True)
    if left:
        datamodule.keep("test", left)
        if config.compile:
            compile_network(module.model, trainer.strategy.root_device)
        run(trainer, trainer.predict, module, datamodule=datamodule, return_predictions=False)
    if not trainer.is_global_zero:
        return
    about = {key.replace("_", " "): text for key, text in cli.plain(config.description).items()}
    ids, root = [frame.id for frame in frames], Path(datamodule.root)
    count = write_submission(file, folder, ids, about, root)
    print(f"done: {count} predictions in {file}, checked by the rules of the test server")


def check_frames(frame_ids: Sequence[str], root: Path) -> None:
    """Raises ``InputError`` unless these are the frames that the server wants."""
    wanted = wanted_frames(root)
    if different := sorted(set(wanted) ^ set(frame_ids)):
        raise InputError(
            f"submission: the server wants the {len(wanted)} frames of sequences 11 to 21 that "
            f"have a .bin, these settings give {len(frame_ids)}, other than {different[0]}: leave "
            "out data.stride, data.test_sequences and data.allow_partial"
        )


def submission_identity(config: DictConfig, module: StageModule) -> dict[str, str]:
    """What the predictions of a submission depend on."""
    digest = hashlib.sha256()
    for name, value in module.model.state_dict().items():
        digest.update(name.encode())
        digest.update(value.reshape(-1).contiguous().view(torch.uint8).numpy().tobytes())
    return {"weights": digest.hexdigest(), "data": str(Path(config.data.root).absolute())}


def continue_folder(folder: Path, identity: dict[str, str]) -> None:
    """Make the folder of a submission's predictions, or go on in it.

    Raises ``InputError`` if those in it are of other weights or of another data set.
    """
    file = folder / "predictions.json"
    remove_temporary_files(folder)
    if file.is_file():
        try:
            found = json.loads(file.read_text())
        except ValueError:
            found = None
        if found != identity:
            raise InputError(
                f"{folder}: has predictions of another checkpoint or data set: remove it, or give "
                "another submission"
            )
    elif folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: is in use: remove it, or give another submission")
    else:
        write_json(file, identity)


def is_predicted(file: Path) -> bool:
    """Whether a whole prediction is there."""
    return file.is_file() and file.stat().st_size == LABEL_BYTES
