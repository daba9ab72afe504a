"""The state of the code that a record keeps."""

import subprocess

from occdetr.study.provenance import code_hash, code_state


def test_state_and_hash_depend_on_code_and_configuration_only(tmp_path):
    assert code_state(tmp_path) == {"commit": None, "dirty": None}
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    (tmp_path / "src").mkdir()
    (tmp_path / "src/a.py").write_text("1")
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        subprocess.run([*git, *command], check=True)
    clean = code_state(tmp_path)
    assert (len(clean["commit"]), clean["dirty"]) == (40, False)
    (tmp_path / "notes.txt").write_text("not code")
    assert code_state(tmp_path) == clean
    before = code_hash(tmp_path)
    (tmp_path / "src/b.py").write_text("2")
    assert code_state(tmp_path) == {**clean, "dirty": True}
    (tmp_path / "src/c.txt").write_text("not code")
    between = code_hash(tmp_path)
    assert len({before, between}) == 2
    (tmp_path / "src/b.py").rename(tmp_path / "src/d.py")
    assert code_hash(tmp_path) not in (before, between)
