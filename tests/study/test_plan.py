"""Studies: which runs they consist of, and how they are run, interrupted and continued."""

import json
import re
import shutil
from pathlib import Path

import pytest
import torch

from occdetr.cli import entry as cli
from occdetr.cli.folders import taken
from occdetr.files import write_json
from occdetr.study import arm as study_arm
from occdetr.study import plan
from programs import STREETS, program, read_json, subprogram, the_error


def planned(name, *settings):
    config = cli.compose("study", [f"name={name}", *settings])
    return plan.planned_runs(config, plan.read_study(name))


def as_list(overrides):
    """Overrides as the value of the setting ``overrides``."""
    return f"overrides=[{','.join(repr(text) for text in overrides)}]"


def places(folder):
    """Settings that keep the outputs and records of a study below ``folder``."""
    return f"folder={folder}/runs", f"results={folder}/results"


# ------------------------------------------------------------------------------------- plans


def test_runs_are_ordered_by_seed_and_have_the_overrides_of_their_arm():
    runs = planned("convergence", "arms=[mixed,two_stage]", "seeds=[4,0]", "overrides=['a=1']")
    names = [run.name for run in runs]
    assert names == ["mixed_seed4", "two_stage_seed4", "mixed_seed0", "two_stage_seed0"]
    assert runs[0].overrides == ("experiment=convergence/mixed", "seed=4", "a=1")
    assert len(planned("convergence")) == 9
    assert len(planned("partition")) == 9


@pytest.fixture(scope="module")
def convergence():
    """The configuration of each arm of the convergence study."""
    return {run.arm: run.settings() for run in planned("convergence", "seeds=[0]")}


@pytest.fixture(scope="module")
def partition():
    """The configuration of each arm and stage of the partition study."""
    return {
        (run.arm, stage): cli.compose("train", [f"stage={stage}", *run.overrides])
        for run in planned("partition", "seeds=[0]")
        for stage in run.stages
    }


def test_arms_of_a_study_train_for_equally_many_steps(convergence, partition):
    """Those of the partition end to end; two are pretrained for as many as convergence."""
    steps = {}
    for (arm, stage), config in partition.items():
        passes = config.trainer.max_epochs * config.data.num_train
        steps[arm, stage] = passes // config.data.batch_size
        assert config.trainer.check_val_every_n_epoch == 1
        assert 1 % config.trainer.val_check_interval == 0  # the last epoch ends with a validation
    arms = ("mixed", "all_foreground", "all_background")
    assert {steps[arm, "full"] for arm in arms} == {960}
    assert {steps[arm, "pretrain"] for arm in arms[:2]} == {1920}
    assert len(steps) == 5
    for config in convergence.values():
        assert config.trainer.max_epochs * config.data.num_train // config.data.batch_size == 1920
        assert config.trainer.max_epochs == 4
        assert config.trainer.val_check_interval == 0.5


def test_arms_differ_in_the_setting_that_they_are_named_after(convergence, partition):
    assert all(config.partition_name == arm for (arm, _), config in partition.items())
    shares = {arm: config.early_matching_share for arm, config in convergence.items()}
    assert shares == {"early_matching": 0.5, "two_stage": 0.0, "mixed": 0.0}
    contents = {arm: config.query_content for arm, config in convergence.items()}
    assert contents == {"early_matching": "token", "two_stage": "token", "mixed": "learned"}


@pytest.mark.parametrize("name", ["convergence", "partition"])
def test_the_larger_protocol_of_the_results_is_that_of_its_text(name):
    """Its overrides replace the streets, batches and epochs of the study."""
    text = (Path(__file__).parents[2] / "docs" / "results.md").read_text().replace("\\\n", "")
    (given,) = re.findall(rf"study name={name} results=docs/results/benchmark .*\"(.*)\"", text)
    for run in planned(name, "seeds=[0]", given):
        for stage in run.stages:
            config = cli.compose("train", [f"stage={stage}", *run.overrides])
            data = config.data
            assert (data.root, data.num_val) == ("data/synthetic-benchmark", 200)
            assert data.num_train * config.trainer.max_epochs / data.batch_size == 6000
            assert config.model_name == "small"
            assert config.backbone_rates.pretrain == 0.3  # all_background takes it as given


def test_every_split_of_the_real_study_holds_out_one_sequence():
    runs = planned("real", "arms=[real,position]")
    assert len(runs) == 20
    every = {"00", "01", "02", "03", "04", "05", "06", "07", "09", "10"}
    seen = set()
    for run in runs[::2]:
        given = dict(text.split("=") for text in run.overrides)
        (held_out,) = json.loads(given["data.val_sequences"])
        train = json.loads(given["data.train_sequences"])
        assert {*train, held_out} == every
        assert len(train) == 9
        seen.add(held_out)
    assert seen == every
    data = runs[0].settings().data
    assert "00" not in data.train_sequences
    assert list(data.val_sequences) == ["00"]


@pytest.mark.parametrize(
    ("settings", "facts"),
    [
        ((), ("name is not set",)),
        (("name=shapes",), ("name=shapes", "convergence, partition, real")),
        (("name=partition", "arms=[two_stage]"), ("arms=", "two_stage", "mixed, all_foreground")),
        (("name=partition", "arms=mixed"), ("arms=mixed", "list", "[mixed]")),
        (("name=partition", "seeds=[-1]"), ("seeds=[-1]", "non-negative")),
        (("name=real", "seeds=[10]"), ("seeds=[10]", "real", "0, 1, 2")),
        (("name=real",), ("start is not set",)),
        (("name=real", "start=none.ckpt"), ("none.ckpt",)),
        (("name=partition", as_list(["trainer.max_epoch=1"])), ("trainer.max_epochs",)),
        (("name=partition", as_list(["data.flip=often"])), ("data.flip=often", "give a number")),
        (("name=partition", as_list(["model=huge"])), ("model=huge",)),
        (("name=partition", "shard=3/2"), ("shard=3/2", "i/n")),
    ],
)
def test_wrong_settings_end_with_one_line_before_anything_runs(settings, facts, tmp_path, capsys):
    assert program("study.plan", *settings, *places(tmp_path)) == 2
    line = the_error(capsys)
    assert all(fact in line for fact in facts), line
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("name", "override", "remedy"),
    [
        ("convergence", "experiment=convergence/two_stage", "choose runs with arms="),
        ("convergence", "query_selection=two_stage", "choose runs with arms="),
        ("convergence", "query_content=token", "choose runs with arms="),
        ("convergence", "early_matching_share=0.5", "choose runs with arms="),
        ("convergence", "module.early_matching_share=0.5", "choose runs with arms="),
        ("convergence", "seed=5", "choose runs with arms= and seeds="),
        ("convergence", "++seed=5", "choose runs with arms= and seeds="),
        ("convergence", "~seed", "choose runs with arms= and seeds="),
        ("convergence", "data={shuffle_seed: 5}", "choose runs with arms= and seeds="),
        ("convergence", "stage=full", "choose runs with arms= and seeds="),
        ("convergence", "resume=allow", "give start=<checkpoint>"),
        ("convergence", "hydra.run.dir=elsewhere", "give folder="),
        ("convergence", "outputs=elsewhere", "give folder="),
        ("partition", "partition=all_background", "choose runs with arms="),
        ("partition", "foreground_classes=[1]", "choose runs with arms="),
        ("partition", "model.detector=null", "choose runs with arms="),
        ("partition", "init_from=scratch", "give start=<checkpoint>"),
        ("real", 'data.val_sequences=["03"]', "choose runs with arms= and seeds="),
        ("real", "data={train_sequences: [03]}", "choose runs with arms= and seeds="),
        ("real", "+data.eval_split=train", "choose runs with arms= and seeds="),
    ],
)
def test_overrides_do_not_replace_what_a_study_decides(name, override, remedy, tmp_path, capsys):
    given = (f"name={name}", "start=tiny", as_list([override]), *places(tmp_path))
    assert program("study.plan", *given) == 2
    line = the_error(capsys)
    assert f"overrides: {override}: " in line
    assert remedy in line
    assert not (tmp_path / "results").exists()


def test_other_overrides_reach_every_arm():
    given = (
        *("model=small", "trainer.max_epochs=2", "epochs={pretrain: 1, full: 2}"),
        *("data=synthetic_benchmark", "data.root=elsewhere", "data.seed=3", "data.num_workers=4"),
    )
    for run in planned("partition", as_list(given), "seeds=[0]"):
        assert run.overrides[2:] == given
        data = run.settings().data
        assert (data.root, data.seed, data.num_workers) == ("elsewhere", 3, 4)


def test_the_choices_of_a_group_include_those_in_its_folders(tmp_path, capsys):
    assert program("train", "experiment=partition/none", f"hydra.run.dir={tmp_path}") == 2
    line = the_error(capsys)
    assert "experiment=partition/none" in line
    assert "convergence/early_matching" in line
    assert "partition/all_background, partition/all_foreground, partition/mixed" in line
    assert "common" not in line


# -------------------------------------------------------------------------------------- runs


def fake_record(run, *_):
    facts = {"study": run.study, "arm": run.arm, "seed": run.seed}
    return {**facts, "figures": {}, "curve": [], "machine": {}, "name": run.name}


def test_a_study_continues_where_it_was_interrupted(tmp_path, monkeypatch, capsys):
    done = []

    def interrupted(run, *_):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(run.name)
        return fake_record(run)

    monkeypatch.setattr(plan, "perform", interrupted)
    given = ("name=convergence", "seeds=[0]", *places(tmp_path))
    assert program("study.plan", *given) == 130
    files = sorted(path.name for path in (tmp_path / "results").rglob("*") if path.is_file())
    assert files == ["early_matching_seed0.json", "two_stage_seed0.json"]
    monkeypatch.setattr(plan, "perform", fake_record)
    assert program("study.plan", *given) == 0
    assert capsys.readouterr().out.count("already exists") == 2
    record = read_json(tmp_path / "results/convergence/mixed_seed0.json")
    assert record["name"] == "mixed_seed0"
    assert record["command"].endswith("'arms=[mixed]' 'seeds=[0]' rebuild=true")
    kept = tmp_path / "results/convergence/two_stage_seed0.json"
    before = kept.stat().st_mtime_ns
    assert program("study.plan", *given) == 0
    assert kept.stat().st_mtime_ns == before
    assert program("study.plan", *given, "rebuild=true", "arms=[two_stage]") == 0
    assert kept.stat().st_mtime_ns > before


def test_shards_share_the_runs_and_may_go_on_side_by_side(tmp_path, monkeypatch, capsys):
    """Each run is in one of them; a record that another job has just made is not made again."""
    done, results = [], tmp_path / "results/convergence"

    def perform(run, *_):
        done.append(run.name)
        if run.name == "early_matching_seed0":  # meanwhile another job ends with the next but one
            other = plan.repeat_command(run).replace("early_matching", "mixed")
            write_json(results / "mixed_seed0.json", {"command": other, **fake_record(mixed)})
        return fake_record(run)

    mixed = next(run for run in planned("convergence") if run.name == "mixed_seed0")
    monkeypatch.setattr(plan, "perform", perform)
    given = ("name=convergence", "seeds=[0,1]", *places(tmp_path))
    for shard in ("1/2", "2/2"):
        assert program("study.plan", *given, f"shard={shard}") == 0
    assert done == [
        *("early_matching_seed0", "two_stage_seed1"),  # the first, third and fifth
        *("two_stage_seed0", "early_matching_seed1", "mixed_seed1"),
    ]
    out = capsys.readouterr().out
    assert out.count("already exists") == 1
    assert "3 runs of shard=1/2" in out
    assert len(list(results.iterdir())) == 6
    assert "shard=" not in read_json(results / "two_stage_seed1.json")["command"]
    assert program("study.plan", *given) == 0  # the whole study, of the same records
    assert capsys.readouterr().out.count("already exists") == 6


def test_two_jobs_do_not_do_the_same_run(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plan, "perform", fake_record)
    given = ("name=convergence", "arms=[mixed]", "seeds=[0]", *places(tmp_path))
    with taken(tmp_path / "runs/convergence/mixed_seed0", "study", "folder"):
        assert program("study.plan", *given) == 2
    assert "mixed_seed0: is in use by another run" in the_error(capsys)


def test_records_of_other_settings_are_not_taken_for_ones_own(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plan, "perform", fake_record)
    given = ("name=convergence", "seeds=[0]", "arms=[mixed]", *places(tmp_path))
    assert program("study.plan", *given) == 0
    other = as_list(["trainer.max_epochs=1"])
    assert program("study.plan", *given, other) == 2
    assert "mixed_seed0.json: was made with other settings" in the_error(capsys)
    assert program("study.plan", *given, other, "rebuild=true") == 0
    assert program("study.plan", *given, other) == 0
    assert "already exists" in capsys.readouterr().out


def test_a_record_from_another_starting_checkpoint_is_not_taken(
    checkpoint, tmp_path, monkeypatch, capsys
):
    """The command is the same, but the file that ``start`` names is another one by now."""

    def perform(run, *_):
        return {**fake_record(run), "start": study_arm.start_facts(run.start)}

    monkeypatch.setattr(plan, "perform", perform)
    start = tmp_path / "start.ckpt"
    shutil.copy(checkpoint, start)
    given = ("name=real", f"start={start}", "arms=[synthetic]", "seeds=[0]", *places(tmp_path))
    assert program("study.plan", *given) == 0
    assert program("study.plan", *given) == 0
    assert "already exists" in capsys.readouterr().out
    saved = torch.load(start, weights_only=True)
    torch.save({**saved, "epoch": saved["epoch"] + 1}, start)
    assert program("study.plan", *given) == 2
    line = the_error(capsys)
    assert f"synthetic_seed0.json: was made from another checkpoint than start={start}" in line
    assert "rebuild=true" in line
    assert program("study.plan", *given, "rebuild=true") == 0
    assert program("study.plan", *given) == 0
    assert "already exists" in capsys.readouterr().out


@pytest.mark.parametrize("content", ["[1]", "{", '{"study": "convergence"}', "quote"])
def test_a_file_that_is_no_record_is_reported(content, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plan, "perform", fake_record)
    given = ("name=convergence", "seeds=[0]", "arms=[mixed]", *places(tmp_path))
    path = tmp_path / "results/convergence/mixed_seed0.json"
    if content == "quote":
        facts = {"study": "convergence", "arm": "mixed", "seed": 0, "command": "an open ' quote"}
        content = json.dumps(facts)
    path.parent.mkdir(parents=True)
    path.write_text(content)
    assert program("study.plan", *given) == 2
    assert f"{path}: is not the record of mixed_seed0: move it away" in the_error(capsys)


def test_a_place_for_the_records_that_is_none_is_reported_before_the_work(tmp_path, capsys):
    (tmp_path / "results").touch()
    assert program("study.plan", "name=convergence", *places(tmp_path)) == 2
    assert f"{tmp_path / 'results'} is a file" in the_error(capsys)


def test_a_setting_that_one_stage_lacks_is_reported_before_the_other_one(tmp_path, capsys):
    only = ("name=partition", "arms=[mixed]", "seeds=[0]", *places(tmp_path))
    assert program("study.plan", *only, as_list(["loss.occupancy.unknown_weight=0.5"])) == 2
    assert "loss.occupancy" in the_error(capsys)
    assert not list(tmp_path.rglob("*.yaml"))


def short(streets, *overrides):
    """Overrides of the shortest training on ``streets``."""
    settings = ("image_size=[64,208]", "trainer=cpu", "trainer.check_val_every_n_epoch=1")
    return as_list((*settings, *STREETS, f"data.root={streets}", *overrides))


def test_a_failing_training_ends_the_study_without_a_record(streets, tmp_path, capfd):
    overrides = short(streets, "trainer.max_epochs=1", "trainer.accelerator=abacus")
    only = ("name=convergence", "arms=[mixed]", "seeds=[0]", overrides)
    assert program("study.plan", *only, *places(tmp_path)) == 2
    assert "abacus" in the_error(capfd)  # printed by the training
    assert not list((tmp_path / "results").rglob("*"))


@pytest.mark.slow
def test_a_whole_study(streets, tmp_path):
    """Two arms of the partition study in subprocesses, a second time, and their tables."""
    only = ("name=partition", "arms=[mixed,all_background]", "seeds=[0]")
    given = (*only, *places(tmp_path), short(streets, "epochs={pretrain: 1, full: 2}"))
    done = subprogram("study", *given)
    assert done.returncode == 0, done.stderr
    mixed, background = (
        read_json(tmp_path / f"results/partition/{arm}_seed0.json")
        for arm in ("mixed", "all_background")
    )
    # two frames: batches of 2 in pretraining, of 1 in full training
    steps = {stage: facts["steps"] for stage, facts in mixed["stages"].items()}
    assert steps == {"pretrain": 1, "full": 4}
    validations = [(point["stage"], point["step"]) for point in mixed["curve"]]
    assert validations == [("pretrain", 1), *(("full", step) for step in (2, 3, 4, 5))]
    assert "mIoU" in mixed["curve"][-1]
    assert list(background["stages"]) == ["full"]
    assert "AP50" not in background["figures"]
    assert background["latency"]["latency_ms"] > 0
    assert background["peak_memory_mb"] > 200
    again = subprogram("study", *given)
    assert again.returncode == 0
    assert again.stdout.count("already exists") == 2
    page = tmp_path / "results.md"
    page.write_text(
        "".join(f"<!-- {name} -->\n<!-- end -->\n" for name in ("convergence", "partition", "real"))
    )
    results = (places(tmp_path)[1], f"page={page}", f"images={tmp_path}/images")
    generated = subprogram("study.results", *results)
    assert generated.returncode == 0, generated.stderr
    assert "| `all_foreground` | - | - | - |" in page.read_text()
