"""Callbacks for tests: what a Trainer was given, and what a job returned to Hydra."""

from hydra.experimental.callback import Callback as HydraCallback
from lightning.pytorch.callbacks import Callback


class TrainerRecorder(Callback):
    """Keeps the last Trainer, and the learning rates of its optimizer before the first step."""

    trainer, rates = None, ()

    def on_train_start(self, trainer, module):
        TrainerRecorder.trainer = trainer
        groups = trainer.optimizers[0].param_groups
        TrainerRecorder.rates = {g["initial_lr"] for g in groups if not g["orthogonal"]}


class JobRecorder(HydraCallback):
    """Keeps what the last job returned: the objective of a sweeper."""

    returned = None

    def on_job_end(self, config, job_return, **kwargs):
        JobRecorder.returned = job_return.return_value
