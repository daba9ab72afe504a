"""One run of a study: what is trained and evaluated, and what its record keeps."""

import shlex

import pytest

from occdetr.classes import CLASS_NAMES
from occdetr.cli.subprocesses import FinishedRun
from occdetr.streets.writer import GENERATOR_VERSION
from occdetr.study import arm as study_arm
from occdetr.study.provenance import file_hash
from programs import SMALL, STREETS, program

SHORT = (*SMALL, "trainer=cpu", "trainer.check_val_every_n_epoch=1")


@pytest.fixture
def in_this_process(monkeypatch):
    """Entry points run in this process instead of in subprocesses."""

    def run(entry, overrides, folder):
        assert program(entry, *overrides, f"hydra.run.dir={folder}") == 0
        return FinishedRun(shlex.join(["python", "-m", f"occdetr.{entry}", *overrides]), 1.0)

    monkeypatch.setattr(study_arm, "run_entry_point", run)


@pytest.mark.usefixtures("in_this_process")
def test_an_arm_of_the_convergence_study(streets, tmp_path):
    experiment = ("experiment=convergence/early_matching", "seed=3")
    run = study_arm.StudyRun(
        study="convergence",
        arm="early_matching",
        seed=3,
        overrides=(*experiment, *SHORT, *STREETS, f"data.root={streets}", "trainer.max_epochs=2"),
        stages=("pretrain",),
        start=None,
        baseline=False,
    )
    record = study_arm.perform(run, tmp_path, latency=None)
    assert [point["step"] for point in record["curve"]] == [1, 2]
    assert set(record["curve"][0]) == {"stage", "step", "mAP", "AP50", "recall3d_25"}
    assert set(record["figures"]) == {"mAP", "AP50", "recall3d_25"}
    stage = record["stages"]["pretrain"]
    assert (record["steps"], stage["steps"], stage["batch_size"], stage["lr"]) == (2, 2, 2, 1e-3)
    assert 200 < record["peak_memory_mb"] == stage["peak_memory_mb"]
    assert 0 < record["seconds"] == stage["seconds"]
    assert record["generator_version"] == GENERATOR_VERSION
    assert "2 frames" in record["data"]["train"]
    assert record["machine"]["cores"] >= 1
    assert len(record["code"]) == 12
    train, evaluate = record["commands"]
    assert "occdetr.train stage=pretrain experiment=convergence/early_matching seed=3" in train
    assert evaluate == f"python -m occdetr.evaluate checkpoint={tmp_path}/pretrain/last.ckpt"


@pytest.mark.usefixtures("in_this_process")
def test_arms_of_the_real_study(streets, checkpoint, tmp_path):
    """``finetuned`` trains from a checkpoint, ``synthetic`` evaluates it, ``position`` has none."""
    settings = (*SHORT, "data.num_workers=0", "trainer.max_epochs=1", f"data.root={streets}")
    settings = (*settings, "data.extra_roots=[]", "data.repeats=1")
    settings = (*settings, "scheduler.warmup_steps=0", "optimizer.lr=0.1")  # one step shows
    sequences = ('data.train_sequences=["00"]', 'data.val_sequences=["01"]')
    records = {}
    for arm, stages in (("finetuned", ("full",)), ("synthetic", ()), ("position", ())):
        run = study_arm.StudyRun(
            study="real",
            arm=arm,
            seed=0,
            overrides=(f"experiment=real/{arm}", *settings, *sequences),
            stages=stages,
            start=None if arm == "position" else checkpoint,
            baseline=arm == "position",
        )
        records[arm] = study_arm.perform(run, tmp_path / arm, latency=None)
    finetuned, synthetic, position = records.values()
    assert finetuned["start"]["sha256"] == synthetic["start"]["sha256"] == file_hash(checkpoint)
    assert position["start"] is None
    assert f"init_from={checkpoint}" in finetuned["commands"][0]
    assert [record["steps"] for record in records.values()] == [1, 0, 0]
    assert finetuned["figures"] != synthetic["figures"]
    assert position["figures"]["mIoU"] > 0
    for record in records.values():
        assert set(record["figures"]["per_class"]) == set(CLASS_NAMES[1:])
        assert record["generator_version"] is None
        assert "1 frame" in record["data"]["val"]
    assert "data=semantickitti" in synthetic["commands"][0]


def test_every_form_of_a_setting_of_the_data_reaches_an_evaluation_without_training():
    given = ("data.stride=5", "++data.num_workers=0", "data={flip: 0.0}", "trainer.max_epochs=1")
    run = study_arm.StudyRun(
        study="real",
        arm="synthetic",
        seed=0,
        overrides=("experiment=real/synthetic", *given),
        stages=(),
        start=None,
        baseline=False,
    )
    data = study_arm.evaluation_data(run, run.settings())
    assert data == ["data=semantickitti", "data.root=data/semantickitti-mini", *given[:3]]
