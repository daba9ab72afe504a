"""What a training starts from, and what it says if that cannot be."""

from types import SimpleNamespace

import pytest

from occdetr.cli import starting_point
from occdetr.cli.starting_point import resumed_run
from occdetr.errors import InputError


@pytest.mark.parametrize("names", [(), ("last.ckpt",), ("last.ckpt", "last-previous.ckpt")])
def test_a_folder_without_a_whole_checkpoint_is_one_line(names, tmp_path, capsys):
    for name in names:
        (tmp_path / name).write_bytes(b"garbage")
    with pytest.raises(InputError, match=rf"^resume={tmp_path}: no whole last\.ckpt in") as error:
        resumed_run({"stage_name": "full", "resume": str(tmp_path)})
    assert all(str(tmp_path / name) in str(error.value) for name in names)
    assert str(error.value).endswith(": give another one")
    assert capsys.readouterr() == ("", "")


def test_weights_beside_a_run_to_resume(monkeypatch):
    """A run that may be a new one or an old one is resume=allow."""
    overrides = ["stage=full", "resume=auto", "init_from=a.ckpt"]
    hydra = SimpleNamespace(overrides=SimpleNamespace(task=overrides))
    monkeypatch.setattr(starting_point.HydraConfig, "get", lambda: hydra)
    given = {"stage_name": "full", "resume": "auto", "init_from": "a.ckpt"}
    with pytest.raises(InputError, match=r"init_from=a\.ckpt: resume=auto .* give resume=allow"):
        starting_point.starting_point(given)
