"""Released models: weights as safetensors with the configuration beside them."""

import json
import shutil

import pytest
import torch
from safetensors.torch import load_file, save_file

from occdetr.errors import InputError
from occdetr.training import released
from occdetr.training.checkpoint import read_checkpoint, restore_model
from occdetr.training.released import write_released
from programs import SHORT, STREETS, program, the_error


@pytest.fixture
def model_file(checkpoint, tmp_path):
    """A checkpoint as a released model."""
    trained = read_checkpoint(checkpoint)
    file = tmp_path / "small.safetensors"
    about = {"stage": trained.stage, "version": trained.version}
    write_released(file, trained.model_state, trained.config, **about)
    return file


def test_weights_are_rounded_and_vectors_are_not(checkpoint, model_file):
    before, after = (restore_model(path)[0].state_dict() for path in (checkpoint, model_file))
    assert before.keys() == after.keys()
    for name, value in before.items():
        assert after[name].dtype == value.dtype
        if value.is_floating_point() and value.ndim > 1:
            torch.testing.assert_close(after[name], value, rtol=2**-8, atol=0)
        else:
            assert torch.equal(after[name], value)
    assert model_file.stat().st_size < 0.6 * sum(value.nbytes for value in before.values())


def test_what_only_the_training_needs_is_left_out(checkpoint, model_file):
    config = read_checkpoint(model_file).config
    assert config["model"] == read_checkpoint(checkpoint).config["model"]
    assert not {"outputs", "trainer", "callbacks", "logger", "init_from"} & set(config)


def test_it_is_evaluated_predicted_with_and_trained_on(
    model_file, streets, tmp_path, capsys, monkeypatch
):
    """By the package's name for it, and with its own network."""
    folder = tmp_path / "released"
    folder.mkdir()
    for file in (model_file, model_file.with_suffix(".json")):
        shutil.copy(file, folder)
    monkeypatch.setattr(released, "FOLDER", folder)
    data = (*STREETS, f"data.root={streets}")
    given = ("checkpoint=small", f"hydra.run.dir={tmp_path}/evaluation", "trainer=cpu")
    assert program("evaluate", *given) == 0
    assert json.loads((tmp_path / "evaluation/metrics.json").read_text())["checkpoint"] == "small"
    given = ("stage=full", "init_from=small", f"hydra.run.dir={tmp_path}/training")
    assert program("train", *given, *SHORT, *data) == 0
    assert "starting from: small" in capsys.readouterr().out
    (image,) = streets.glob("sequences/08/image_2/000000.png")
    pictures = (f"images={image}", f"calib={image.parents[1]}/calib.txt", "device=cpu")
    assert program("predict", "checkpoint=small", *pictures, f"hydra.run.dir={tmp_path}/out") == 0
    assert (tmp_path / "out/000000.label").stat().st_size == 2 * 256 * 256 * 32
    given = ("stage=full", "resume=small", f"hydra.run.dir={tmp_path}/resumed")
    assert program("train", *given, *SHORT, *data) == 2
    assert "start from its weights with init_from=small" in the_error(capsys)


def test_a_file_of_the_users_comes_before_a_name_of_the_package(model_file, tmp_path, monkeypatch):
    monkeypatch.setattr(released, "FOLDER", model_file.parent)
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert read_checkpoint("small").stage == "full"
    (folder / "small").write_text("notes")
    with pytest.raises(InputError, match="checkpoint=small: not a readable checkpoint"):
        read_checkpoint("small")


def test_an_unknown_name_lists_those_that_there_are(model_file, monkeypatch):
    monkeypatch.setattr(released, "FOLDER", model_file.parent)
    with pytest.raises(InputError, match=r"checkpoint=large: no such file; .*, or small$"):
        read_checkpoint("large")


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        ("no json", "there is no small.json beside it: keep both files together"),
        ("half of the json", "not a readable checkpoint"),
        ("json without a stage", "not a readable checkpoint"),
        ("json that is a list", "not a readable checkpoint"),
        ("half of the weights", "not a readable checkpoint"),
        ("other weights", "of a larger network than its weights"),
        ("not finite", "encoder.level_embed is not finite"),
        ("code", "_target_=pathlib.Path.touch"),
    ],
)
def test_damaged(damage, expected, model_file):
    text_file = model_file.with_suffix(".json")
    text, content = text_file.read_text(), model_file.read_bytes()
    about, state = json.loads(text), load_file(model_file)
    if damage == "no json":
        text_file.unlink()
    elif damage == "half of the json":
        text_file.write_text(text[: len(text) // 2])
    elif damage == "json without a stage":
        text_file.write_text(json.dumps({"config": about["config"]}))
    elif damage == "json that is a list":
        text_file.write_text(json.dumps([about]))
    elif damage == "half of the weights":
        model_file.write_bytes(content[: len(content) // 2])
    elif damage == "other weights":
        save_file({"weight": torch.zeros(3)}, model_file)
    elif damage == "not finite":
        state["encoder.level_embed"][0] = torch.nan
        save_file(state, model_file)
    else:
        about["config"]["model"]["encoder"] = {"_target_": "pathlib.Path.touch"}
        text_file.write_text(json.dumps(about))
    with pytest.raises(InputError, match=expected):
        restore_model(model_file)


def test_export_writes_both_files(varied_checkpoint, tmp_path, capsys):
    file = tmp_path / "given/mine.safetensors"
    given = (f"checkpoint={varied_checkpoint}", f"hydra.run.dir={tmp_path}/run", "device=cpu")
    assert program("export", *given, "format=safetensors", f"output={file}") == 0
    assert sorted(path.name for path in file.parent.iterdir()) == ["mine.json", "mine.safetensors"]
    assert "after rounding to bf16, on a synthetic street: " in capsys.readouterr().out
    report = json.loads((tmp_path / "run/export.json").read_text())
    assert report["parity"]["voxels"] > 0.9
    expected = restore_model(varied_checkpoint)[0].state_dict()
    assert restore_model(file)[0].state_dict().keys() == expected.keys()


def test_a_threshold_is_not_exported_with_weights(tmp_path, capsys):
    given = ("checkpoint=any.ckpt", f"hydra.run.dir={tmp_path}/run", "format=safetensors")
    assert program("export", *given, "score_threshold=0.3") == 2
    assert "score_threshold=0.3: is not kept" in the_error(capsys)
