"""What a run's loggers show beside figures and pictures: who it is, curves, a confusion matrix."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

import lightning
import numpy as np
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.tensorboard.summary import hparams

from occdetr.drawing.confusion import draw_confusion
from occdetr.evaluation.precision_recall import PrecisionRecall, precision_recall_curves
from occdetr.training.callbacks import ValidationRecord
from occdetr.training.pictures import SECTION, log_picture, picture_loggers

#: Figures of the last validation by which runs are compared.
FINAL = ("mIoU", "IoU", "AP50")


def tensorboards(trainer: lightning.Trainer) -> list[Any]:
    """The writers of TensorBoard's files, on the first rank."""
    every = trainer.loggers if trainer.is_global_zero else []
    return [each.experiment for each in every if isinstance(each, TensorBoardLogger)]


class ChartLogger(Callback):
    """Draws what every validation has counted, without counting anything again.

    Precision by recall of the image boxes at an IoU of 0.5, by class and over all (TensorBoard
    alone has such curves), and, of the whole network, the confusion matrix of the voxels.
    """

    def on_validation_end(self, trainer: lightning.Trainer, module: Any) -> None:
        if trainer.sanity_checking:
            return
        step = trainer.global_step
        if writers := tensorboards(trainer):
            curves = precision_recall_curves(module.evaluator.detection.boxes.values())
            for writer in writers:
                for name, curve in curves.items():
                    add_curve(writer, f"val_precision_recall/{name}", curve, step)
        confusion = module.results.get("confusion")
        if confusion is not None and (loggers := picture_loggers(trainer)):
            picture = draw_confusion(np.array(confusion).sum(axis=0))  # over the distances
            log_picture(loggers, f"{SECTION}/confusion", picture, step)


def add_curve(writer: Any, name: str, curve: PrecisionRecall, step: int) -> None:
    """Give TensorBoard a curve. There are no true negatives: a detector has no such number."""
    counts = (curve.true_positives, curve.false_positives)
    counts = (*counts, np.zeros_like(curve.true_positives), curve.false_negatives)
    shape = curve.precision, curve.recall
    writer.add_pr_curve_raw(name, *counts, *shape, step, num_thresholds=len(curve.precision))


class RunCard(Callback):
    """Says at a run's beginning who it is, and at its end what came out.

    All loggers get the command line as a hyper-parameter, beside the configuration, which
    Lightning gives them, and at the end the figures ``final/...``: ``FINAL`` of the last
    validation, and ``best``, that of ``best.ckpt``. TensorBoard also gets both texts, and
    ``hyperparameters`` for its table of runs (HParams). An interrupted run has no final figures.

    The table's columns are left to TensorBoard, which then takes those of all runs. Lightning's
    ``log_hyperparams(params, metrics)`` would write the columns of each run, and TensorBoard would
    use one run's alone.
    """

    def __init__(
        self,
        command_line: str,
        configuration: str,
        hyperparameters: Mapping[str, str | float],
        record: ValidationRecord,
        best: ModelCheckpoint,
    ) -> None:
        self.command_line, self.configuration = command_line, configuration
        self.hyperparameters = dict(hyperparameters)
        self.record, self.best = record, best

    def on_train_start(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        step, start = trainer.global_step, hparams(self.hyperparameters, {})[1]
        for logger in trainer.loggers if trainer.is_global_zero else ():
            logger.log_hyperparams({"command_line": self.command_line})
        for writer in tensorboards(trainer):
            writer.add_text("command_line", as_code(in_lines(self.command_line)), step)
            writer.add_text("configuration", as_code(self.configuration), step)
            writer._get_file_writer().add_summary(start, step)

    def teardown(self, trainer: lightning.Trainer, pl_module: Any, stage: str) -> None:
        """A run that had no validation has one after ``fit``, which then ends it."""
        if not trainer.is_global_zero or not (self.record.validations or stage == "validate"):
            return
        step, end = trainer.global_step, hparams(self.hyperparameters, {})[2]
        for logger in trainer.loggers:
            logger.log_metrics(self.final_figures(), step)
        for writer in tensorboards(trainer):
            writer._get_file_writer().add_summary(end, step)

    def final_figures(self) -> dict[str, float]:
        """Empty without a validation."""
        last = self.record.validations[-1] if self.record.validations else {}
        figures = {f"final/{name}": last[name] for name in FINAL if name in last}
        best = self.best.best_model_score
        return figures if best is None else figures | {"final/best": float(best)}


def in_lines(command: str) -> str:
    """``python -m <module> <overrides>`` with a line for each override, for a shell."""
    words = [shlex.quote(word) for word in shlex.split(command)]
    return " \\\n".join([" ".join(words[:3]), *(f"  {word}" for word in words[3:])])


def as_code(text: str) -> str:
    """Markdown that shows ``text`` as it is."""
    return "\n".join(f"    {line}" for line in text.splitlines())
