"""Programs with ``compile=true``."""

import re

import numpy as np
import pytest
from torch._inductor import config as inductor_config

from occdetr.data.semantickitti import read_raw_labels
from programs import SHORT, STREETS, program, subprogram, the_error


@pytest.fixture
def no_compiler():
    with inductor_config.patch({"cpp.cxx": ("/nowhere/g++",)}):
        yield


def given_to_predict(checkpoint, streets):
    source = streets / "sequences/08"
    images = f"images={source / 'image_2/000000.png'}"
    return f"checkpoint={checkpoint}", images, f"calib={source / 'calib.txt'}", "device=cpu"


@pytest.mark.usefixtures("no_compiler")
def test_a_missing_compiler_is_reported(checkpoint, streets, tmp_path, capsys):
    folder = tmp_path / "run"
    predict = given_to_predict(checkpoint, streets)
    data = (*STREETS, f"data.root={streets}", "logger=none")
    train = ("stage=pretrain", *SHORT, *data)
    evaluate = (f"checkpoint={checkpoint}", "trainer=cpu")
    for entry, given in (("predict", predict), ("train", train), ("evaluate", evaluate)):
        assert program(entry, *given, "compile=true", f"hydra.run.dir={folder}") == 2
        line = the_error(capsys)
        assert "compile=true" in line
        assert "install a C++ compiler" in line
        assert not list(folder.glob("[!.]*"))


@pytest.mark.parametrize(
    "given", ["compile=true", "save_predictions=true", "exchange_images=true", "pictures=2"]
)
def test_an_upper_bound_runs_no_network(given, capsys, tmp_path):
    bound = ("upper_bound=true", "model=tiny", f"hydra.run.dir={tmp_path / 'run'}")
    assert program("evaluate", *bound, given) == 2
    assert given in the_error(capsys)


@pytest.mark.slow
def test_a_compiled_network_predicts_the_same(varied_checkpoint, streets, tmp_path):
    grids = []
    for compiled in ("false", "true"):
        folder = tmp_path / compiled
        given = (*given_to_predict(varied_checkpoint, streets), f"hydra.run.dir={folder}")
        done = subprogram("predict", *given, f"compile={compiled}")
        assert done.returncode == 0, done.stderr
        assert re.search("done: 1 image", done.stdout)
        grids.append(read_raw_labels(folder / "000000.label"))
    assert np.mean(grids[0] != grids[1]) < 1e-3
