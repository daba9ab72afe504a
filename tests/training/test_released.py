"""Released models: one file of weights and their configuration."""

import json
import shutil
import struct

import pytest
import torch
from safetensors import safe_open
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
    stored = load_file(model_file)
    for name, value in before.items():
        if value.is_floating_point() and value.ndim > 1:
            assert stored[name].dtype == torch.bfloat16
            torch.testing.assert_close(after[name], value, rtol=2**-8, atol=0)
        else:
            assert stored[name].dtype == value.dtype
            assert torch.equal(after[name], value)
    assert model_file.stat().st_size < 0.6 * sum(value.nbytes for value in before.values())


def test_neither_the_run_nor_the_data_is_kept(checkpoint, model_file, tmp_path, capsys):
    """No folder of the one who trained it, and nothing to write for the one who evaluates it."""
    config, trained = read_checkpoint(model_file).config, read_checkpoint(checkpoint).config
    assert config["model"] == trained["model"]
    assert not {"outputs", "trainer", "callbacks", "logger", "init_from"} & set(config)
    assert str(trained["data"]["root"]) not in json.dumps(config)
    given = (f"checkpoint={model_file}", f"hydra.run.dir={tmp_path}/evaluation", "trainer=cpu")
    assert program("evaluate", *given) == 2
    assert "a released model has no data set: give data=synthetic_demo" in the_error(capsys)


def test_it_is_evaluated_predicted_with_and_trained_on(
    model_file, streets, tmp_path, capsys, monkeypatch
):
    """By the package's name for it, and with its own network."""
    folder = tmp_path / "released"
    folder.mkdir()
    shutil.copy(model_file, folder)
    monkeypatch.setattr(released, "FOLDER", folder)
    data = (*STREETS, f"data.root={streets}")
    given = ("checkpoint=small", f"hydra.run.dir={tmp_path}/evaluation", "trainer=cpu")
    assert program("evaluate", *given, "data=synthetic", *data) == 0
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


def with_text(file, text):
    """Replace the configuration of a released model."""
    save_file(load_file(file), file, {"occdetr": text})


def with_header(file, **tensors):
    """Replace what a file says of its tensors."""
    metadata = {"occdetr": without_hash(json.loads(text_of(file)))}
    header = json.dumps({"__metadata__": metadata, **tensors}).encode()
    file.write_bytes(struct.pack("<Q", len(header)) + header)


def without_hash(about):
    """The text of a file whose weights somebody has changed on purpose."""
    return json.dumps({key: value for key, value in about.items() if key != "sha256"})


def text_of(file):
    with safe_open(file, "pt") as content:
        return content.metadata()["occdetr"]


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        ("half of the weights", "not a readable model"),
        ("zeros", "not a readable model"),
        ("a name of another weight", "not a readable model"),
        ("no configuration", "not a readable model"),
        ("half of the configuration", "not a readable model"),
        ("configuration without a stage", "not a readable model"),
        ("configuration that is a list", "not a readable model"),
        ("deep configuration", "not a readable model"),
        ("long configuration", "not a readable model"),
        ("many axes", "w is no plain array of numbers"),
        ("long axes", "w is no plain array of numbers"),
        ("other weights", "of a larger network than its weights"),
        ("not finite", "encoder.level_embed is not finite"),
        ("code", "_target_=pathlib.Path.touch"),
    ],
)
def test_damaged(damage, expected, model_file, tmp_path):
    text, content = text_of(model_file), model_file.read_bytes()
    about, state = json.loads(text), load_file(model_file)
    if damage == "half of the weights":
        model_file.write_bytes(content[: len(content) // 2])
    elif damage == "no configuration":
        save_file(state, model_file)
    elif damage == "half of the configuration":
        with_text(model_file, text[: len(text) // 2])
    elif damage == "configuration without a stage":
        with_text(model_file, json.dumps({"config": about["config"]}))
    elif damage == "configuration that is a list":
        with_text(model_file, json.dumps([about]))
    elif damage == "deep configuration":
        with_text(model_file, "[" * 100_000)
    elif damage == "long configuration":
        with_text(model_file, text + " " * 2**20)
    elif damage == "many axes":
        with_header(model_file, w={"dtype": "F32", "shape": [0] * 100, "data_offsets": [0, 0]})
    elif damage == "long axes":
        shape = [0, 2**62, 2**62]
        with_header(model_file, w={"dtype": "F32", "shape": shape, "data_offsets": [0, 0]})
    elif damage == "other weights":
        save_file({"weight": torch.zeros(3)}, model_file, {"occdetr": without_hash(about)})
    elif damage == "not finite":
        state["encoder.level_embed"][0] = torch.nan
        save_file(state, model_file, {"occdetr": without_hash(about)})
    elif damage == "zeros":
        middle = len(content) // 2
        model_file.write_bytes(content[:middle] + bytes(512) + content[middle + 512 :])
    elif damage == "a name of another weight":
        state["encoder.level_embed2"] = state.pop("encoder.level_embed")
        save_file(state, model_file, {"occdetr": text})
    else:
        made = tmp_path / "made"
        about["config"]["model"]["encoder"] = {"_target_": "pathlib.Path.touch", "self": str(made)}
        with_text(model_file, json.dumps(about))
    with pytest.raises(InputError, match=expected):
        restore_model(model_file)
    assert not (tmp_path / "made").exists()


def test_the_models_of_the_package_are_whole(tmp_path, monkeypatch):
    assert released.PUBLISHED.keys() <= {path.name for path in released.FOLDER.iterdir()}
    folder = tmp_path / "released"
    folder.mkdir()
    content = (released.FOLDER / "tiny.safetensors").read_bytes()
    (folder / "tiny.safetensors").write_bytes(content)
    monkeypatch.setattr(released, "FOLDER", folder)
    read_checkpoint("tiny")
    middle = len(content) // 2
    (folder / "tiny.safetensors").write_bytes(
        content[:middle] + bytes(65536) + content[middle + 65536 :]
    )
    with pytest.raises(InputError, match="checkpoint=tiny: not a readable model"):
        read_checkpoint("tiny")


def test_export_writes_one_file(varied_checkpoint, tmp_path, capsys):
    file = tmp_path / "given/mine.safetensors"
    given = (f"checkpoint={varied_checkpoint}", f"hydra.run.dir={tmp_path}/run", "device=cpu")
    assert program("export", *given, "format=safetensors", f"output={file}") == 0
    assert [path.name for path in file.parent.iterdir()] == ["mine.safetensors"]
    assert "after rounding to bf16, on a synthetic street: " in capsys.readouterr().out
    report = json.loads((tmp_path / "run/export.json").read_text())
    assert report["parity"]["voxels"] > 0.9
    expected = restore_model(varied_checkpoint)[0].state_dict()
    assert restore_model(file)[0].state_dict().keys() == expected.keys()


def test_a_threshold_is_not_exported_with_weights(tmp_path, capsys):
    given = ("checkpoint=any.ckpt", f"hydra.run.dir={tmp_path}/run", "format=safetensors")
    assert program("export", *given, "score_threshold=0.3") == 2
    assert "score_threshold=0.3: is not kept" in the_error(capsys)
