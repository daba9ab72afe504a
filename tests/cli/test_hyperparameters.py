"""The settings by which runs are compared."""

from __future__ import annotations

from occdetr.cli.hyperparameters import compared

SETTINGS = {
    "seed": 3,
    "optimizer": {"lr": 2e-4, "betas": [0.9, 0.95]},
    "data": {"batch_size": 4, "flip": 0.0, "root": "streets"},
    "trainer": {"max_epochs": 2, "devices": 2},
    "loss": {"occupancy": {"unknown_weight": 1.0}},
    "init_from": "scratch",
}
CHOICES = {
    **{"stage": "full", "model": "tiny", "partition": "mixed", "data": "synthetic"},
    **{"query_selection": "two_stage", "optimizer": "adamw", "logger": "csv"},
    **{"callbacks": ["default", "ema"], "hydra/launcher": "basic"},
}


def test_groups_settings_and_what_was_typed_are_compared() -> None:
    given = ["optimizer.betas=[0.9,0.95]", "loss.occupancy.unknown_weight=1.0", "optimizer=adamw"]
    given += ["callbacks=[default,ema]", "init_from=scratch", "+data.flip=0"]
    assert compared(SETTINGS, CHOICES, given) == {
        **{"stage": "full", "model": "tiny", "partition": "mixed", "data": "synthetic"},
        **{"query_selection": "two_stage", "optimizer": "adamw", "optimizer.lr": 2e-4},
        **{"data.batch_size": 4, "trainer.max_epochs": 2, "seed": 3},
        **{"optimizer.betas": "[0.9, 0.95]", "loss.occupancy.unknown_weight": 1.0},
        **{"callbacks": "['default', 'ema']", "init_from": "scratch", "data.flip": 0.0},
    }


def test_places_devices_and_logs_are_not_compared() -> None:
    given = ["data.root=streets", "trainer.devices=2", "logger=csv", "resume=allow"]
    given += ["outputs=elsewhere", "hydra.run.dir=here", "hydra/launcher=basic", "trainer=cpu"]
    assert compared(SETTINGS, CHOICES, given) == compared(SETTINGS, CHOICES, [])
