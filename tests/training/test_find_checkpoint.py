"""Which earlier run ``init_from=auto`` and ``resume=auto`` take."""

import copy
import functools
import os

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from model_factory import tiny_config
from occdetr.cli.entry import plain
from occdetr.errors import InputError
from occdetr.training import find_checkpoint
from occdetr.training.checkpoint import read_checkpoint
from occdetr.training.find_checkpoint import (
    carry_on,
    other_overrides,
    pretraining_for,
    run_to_resume,
)


@pytest.fixture
def outputs(tmp_path):
    return tmp_path / "outputs"


@functools.cache
def composed(stage):
    return tiny_config(stage=stage)


def settings(outputs, stage, *overrides):
    config = copy.deepcopy(composed(stage))
    for text in (f"outputs={outputs}", *overrides):
        key, _, value = text.partition("=")
        OmegaConf.update(config, key, yaml.safe_load(value))
    return plain(config)


def run(outputs, name, *overrides, stage="pretrain", finished=True, age=0):
    """The folder of a run without its network."""
    folder = outputs / stage / name
    (folder / ".hydra").mkdir(parents=True)
    config = settings(outputs, stage, *overrides)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / ".hydra/overrides.yaml").write_text(yaml.safe_dump([f"stage={stage}", *overrides]))
    about = {"stage": stage, "version": "0"}
    content = {"occdetr": about, "hyper_parameters": config, "state_dict": {}}
    torch.save(content, folder / "last.ckpt")
    os.utime(folder / "last.ckpt", (1e9 - age, 1e9 - age))
    if finished:
        (folder / "metrics.json").write_text("{}")
    return folder / "last.ckpt"


def pretraining(outputs, *overrides):
    config = settings(outputs, "full", *overrides)
    return pretraining_for(config, ["stage=full", f"outputs={outputs}", *overrides])


def test_a_full_training_takes_the_pretraining_of_its_own_seed(outputs):
    runs = [run(outputs, f"seed{seed}", f"seed={seed}", age=-seed) for seed in (0, 1)]
    for seed in (0, 1):
        assert pretraining(outputs, f"seed={seed}") == runs[seed]


def test_a_full_training_takes_the_pretraining_of_its_own_arm(outputs):
    rates = ("1e-4", "2e-4")
    runs = {rate: run(outputs, f"lr{rate}", f"optimizer.lr={rate}") for rate in rates}
    for rate in rates:
        assert pretraining(outputs, f"optimizer.lr={rate}") == runs[rate]
    with pytest.raises(InputError, match="2 pretrainings fit") as caught:
        pretraining(outputs, "optimizer.lr=3e-4")
    assert all(
        f"{path}: it has optimizer.lr={rate}" in str(caught.value) for rate, path in runs.items()
    )


def test_a_pretraining_of_another_query_selection_is_not_taken(outputs):
    run(outputs, "other", "early_matching_share=0.0")
    with pytest.raises(InputError, match=r"early_matching_share 0\.0 -> 1\.0"):
        pretraining(outputs)


def test_what_is_taken_says_how_its_settings_differ(outputs):
    path = run(outputs, "other", "optimizer.lr=1e-4")
    assert pretraining(outputs, "trainer.max_epochs=3") == path
    text = other_overrides(path, ["stage=full", "trainer.max_epochs=3", f"outputs={outputs}"])
    assert text == "it has optimizer.lr=1e-4, without trainer.max_epochs=3"
    assert other_overrides(path, ["stage=full", "optimizer.lr=1e-4"]) == ""


def test_refusals_list_every_candidate_and_what_is_wrong_with_it(outputs):
    run(outputs, "other_seed", "seed=3")
    run(outputs, "other_data", "data.num_train=9")
    run(outputs, "unfinished", finished=False)
    with pytest.raises(InputError, match="init_from=scratch or init_from=<path>") as caught:
        pretraining(outputs)
    text = str(caught.value)
    assert "other_seed/last.ckpt: " in text
    assert "seed 3 -> 0" in text
    assert "other_data/last.ckpt: data.num_train 9 -> 200" in text
    assert "unfinished/last.ckpt: not finished" in text


def test_two_runs_of_the_same_settings_are_not_guessed_between(outputs):
    for name in ("first", "second"):
        run(outputs, name)
    with pytest.raises(InputError, match=r"the same settings.*the same settings"):
        pretraining(outputs)


def resumed(outputs, *overrides):
    warnings = []
    config = settings(outputs, "pretrain", "resume=auto", *overrides)
    checkpoint = run_to_resume(config, warnings.append)
    return (checkpoint and checkpoint.path), warnings


def test_resuming_takes_the_newest_run_of_the_same_settings(outputs):
    older = run(outputs, "a", "optimizer.lr=1e-4", finished=False, age=2)
    newer = run(outputs, "b", "optimizer.lr=1e-4", finished=False, age=1)
    other = run(outputs, "c", "optimizer.lr=2e-4", finished=False)
    run(outputs, "d", "seed=1", finished=False)
    assert resumed(outputs, "optimizer.lr=1e-4") == (newer, [])
    assert resumed(outputs, "optimizer.lr=2e-4") == (other, [])
    assert resumed(outputs, "seed=2") == (None, [])
    with pytest.raises(InputError, match=r"several settings would fit: .*give resume=<run folder>"):
        resumed(outputs, "optimizer.lr=3e-4")
    newer.write_bytes(newer.read_bytes()[:-100])
    path, warnings = resumed(outputs, "optimizer.lr=1e-4")
    assert path == older
    assert str(newer) in warnings[0]


def test_changed_settings_are_taken_over_if_only_one_run_is_meant(outputs):
    only = run(outputs, "a", finished=False)
    assert resumed(outputs, "optimizer.lr=3e-4") == (only, [])


def test_a_job_of_a_sweep_does_not_continue_another_job(outputs):
    """The settings that a sweep varies are often those that a resumed run may change."""
    own = run(outputs, "a", "optimizer.lr=1e-4", finished=False)
    for lr, found in (("1e-4", own), ("3e-4", None)):
        config = settings(outputs, "pretrain", "resume=allow", f"optimizer.lr={lr}")
        checkpoint = run_to_resume(config, pytest.fail, of_sweep=True)
        assert (checkpoint and checkpoint.path) == found


def test_a_finished_run_is_not_resumed_unless_it_goes_further(outputs):
    run(outputs, "a", "trainer.max_epochs=3", finished=False, age=1)
    last = run(outputs, "b", "trainer.max_epochs=3")
    with pytest.raises(InputError, match=r"b: that run has finished: raise .*max_epochs \(now 3\)"):
        resumed(outputs, "trainer.max_epochs=3")
    last.parent.joinpath("metrics.json").unlink()
    assert resumed(outputs, "trainer.max_epochs=3") == (last, [])


@pytest.mark.parametrize("damage", ["truncated", "flipped"])
def test_a_damaged_checkpoint_falls_back_to_the_one_before(damage, outputs):
    last = run(outputs, "a", finished=False)
    previous = last.with_name("last-previous.ckpt")
    content = torch.load(last, weights_only=True)
    content["state_dict"]["model.weight"] = torch.zeros(1000)
    torch.save(content, last)
    torch.save(content, previous)
    data = bytearray(last.read_bytes())
    if damage == "flipped":
        place = data.index(bytes(2000)) + 1000  # in the weights, where no format is broken
        data[place] ^= 1
    last.write_bytes(data if damage == "flipped" else data[: len(data) // 2])
    path, warnings = resumed(outputs)
    assert path == previous
    assert len(warnings) == 1
    assert str(last) in warnings[0]


def test_a_folder_is_one_to_resume_from_when_it_has_the_best_so_far(outputs, tmp_path, monkeypatch):
    """A run that is killed while it takes over another one does not hide that one's best."""
    last = run(outputs, "killed")
    (last.parent / "best.ckpt").write_bytes(last.read_bytes())
    taken = []

    def keep_as(file, other):
        taken.append(other.name)
        raise KeyboardInterrupt

    monkeypatch.setattr(find_checkpoint, "keep_as", keep_as)
    with pytest.raises(KeyboardInterrupt):
        carry_on(read_checkpoint(last), tmp_path / "new")
    assert taken == ["best.ckpt"]


def test_a_damaged_best_checkpoint_is_left_behind_with_a_warning(outputs, tmp_path):
    last = run(outputs, "killed")
    (last.parent / "best.ckpt").write_bytes(last.read_bytes()[:100])
    (tmp_path / "new").mkdir()
    with pytest.warns(UserWarning, match=r"best\.ckpt: not a readable .* counted anew"):
        carry_on(read_checkpoint(last), tmp_path / "new")
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["last.ckpt"]
