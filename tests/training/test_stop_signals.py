"""Signals of a training: which are noted, and who requeues the job."""

import signal
from types import SimpleNamespace

import pytest
from lightning.fabric.plugins.environments import LightningEnvironment
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment

from occdetr.training.stop_signals import STOPPED, StoppedBySignal, StopSignals

NUMBERS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)


@pytest.fixture
def handlers():
    """The handlers before the test, which are restored."""
    before = {number: signal.getsignal(number) for number in NUMBERS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize(
    ("slurm", "submitit", "sent", "requeued"),
    [
        (False, None, signal.SIGUSR1, False),
        (True, None, signal.SIGUSR1, True),
        (True, None, signal.SIGTERM, False),
        (True, "", signal.SIGUSR2, True),  # Lightning's own requeueing is on SIGUSR1
        (True, "", signal.SIGUSR1, False),
        (False, "", signal.SIGUSR2, True),
        (False, "USR1", signal.SIGUSR1, True),
        (False, "", signal.SIGTERM, False),
    ],
)
def test_only_the_announcing_signal_requeues(slurm, submitit, sent, requeued, monkeypatch):
    calls = []
    announcing = f"SIG{submitit or ('USR1' if submitit is None else 'USR2')}"
    signal.signal(signal.Signals[announcing], lambda number, frame: calls.append(number))
    if submitit is not None:
        monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    if submitit:
        monkeypatch.setenv("SUBMITIT_PREEMPT_SIGNAL", submitit)
    environment = SLURMEnvironment() if slurm else LightningEnvironment()
    trainer = SimpleNamespace(
        _accelerator_connector=SimpleNamespace(cluster_environment=environment), world_size=1
    )
    signals = StopSignals()
    signals.watch(trainer)
    signal.raise_signal(sent)
    assert signals.agreed(trainer) == sent
    assert calls == []  # not before the checkpoint
    with pytest.raises(StoppedBySignal) as stopped:
        signals.stop(sent)
    assert stopped.value.code == STOPPED
    assert calls == ([sent] if requeued else [])


@pytest.mark.usefixtures("handlers")
def test_the_code_by_which_a_launcher_starts_a_job_again_is_kept(monkeypatch):
    def requeue(number, frame):
        raise SystemExit(144)

    monkeypatch.setenv("SUBMITIT_EXECUTOR", "local")
    signal.signal(signal.SIGUSR2, requeue)
    connector = SimpleNamespace(cluster_environment=LightningEnvironment())
    signals = StopSignals()
    signals.watch(SimpleNamespace(_accelerator_connector=connector))
    with pytest.raises(StoppedBySignal) as stopped:
        signals.stop(signal.SIGUSR2)
    assert (stopped.value.code, stopped.value.name) == (144, "SIGUSR2")
