"""A callback that ends a run as a kill would: at a step, without any last word."""

from lightning.pytorch.callbacks import Callback


class Killed(BaseException):
    pass


class CrashAfter(Callback):
    """Raises ``Killed`` when ``steps`` optimizer steps have been taken."""

    def __init__(self, steps):
        self.steps = steps

    def on_train_batch_start(self, trainer, *args):
        if trainer.global_step >= self.steps:
            raise Killed


def crash(steps):
    """The setting that adds it to a run."""
    return f"trainer.callbacks=[{{_target_: crash.CrashAfter, steps: {steps}}}]"
