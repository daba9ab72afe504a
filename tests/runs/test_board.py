"""What TensorBoard shows of a sweep over both stages, read back from its files."""

import pytest
import yaml
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams import api_pb2, list_session_groups
from tensorboard.plugins.hparams.backend_context import Context

from occdetr.classes import CLASS_NAMES
from programs import SHORT, STREETS, newest, program, read_json


def board(runs, stage):
    """The events of a stage's run, and its folder."""
    folder = newest(runs, f"{stage}/*/metrics.json").parent
    events = EventAccumulator(str(folder / "tensorboard"), {"images": 0, "tensors": 0})
    return events.Reload(), folder


def text(events, name):
    return events.Tensors(f"{name}/text_summary")[0].tensor_proto.string_val[0].decode()


def sections(events):
    return {name.split("/")[0] for name in events.Tags()["scalars"]}


def test_every_class_has_its_iou(runs):
    events, _ = board(runs, "full")
    assert sections(events) == {"val", "val_iou", "final", "epoch"}  # no step was logged
    assert {f"val_iou/{name}" for name in CLASS_NAMES[1:]} <= set(events.Tags()["scalars"])


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_pictures_curves_and_texts(stage, runs):
    events, folder = board(runs, stage)
    names = ["08_000000", "confusion"] if stage == "full" else ["08_000000"]
    assert sorted(events.Tags()["images"]) == [f"val_pictures/{name}" for name in names]
    assert "val_precision_recall/all" in events.Tags()["tensors"]
    assert yaml.safe_load(text(events, "configuration")) == yaml.safe_load(
        (folder / "config.yaml").read_text()
    )
    first, *overrides = text(events, "command_line").splitlines()
    assert first == "    python -m occdetr.train \\"
    assert overrides[0] == f"      stage={stage} \\"
    assert overrides[2] == "      'image_size=[64,208]' \\"
    assert not overrides[-1].endswith("\\")


def session_groups(folder):
    """The rows of TensorBoard's table of runs (HParams), and its columns."""
    multiplexer = EventMultiplexer().AddRunsFromDirectory(str(folder)).Reload()
    context = Context(TBContext(data_provider=MultiplexerDataProvider(multiplexer, str(folder))))
    request = api_pb2.ListSessionGroupsRequest(
        allowed_statuses=[api_pb2.STATUS_SUCCESS], slice_size=100, start_index=0
    )
    handler = list_session_groups.Handler(
        RequestContext(), context, experiment_id="", request=request
    )
    every = context.hparams_metadata(RequestContext(), "")
    experiment = context.experiment_from_metadata(RequestContext(), "", True, every, [])
    return handler.run().session_groups, experiment


def test_the_table_of_runs_compares_a_sweep(runs):
    rows, columns = session_groups(runs)
    by_stage = {row.hparams["stage"].string_value: row for row in rows}
    assert {"pretrain", "full"} == set(by_stage)
    names = [info.name for info in columns.hparam_infos]
    assert {"optimizer.lr", "data.batch_size", "seed", "image_size"} <= set(names)
    assert not {"data.root", "outputs", "trainer"} & set(names)
    assert [info.name for info in columns.hparam_infos if info.differs][-1] == "stage"
    shown = [info.name.tag for info in columns.metric_infos][:5]  # without being chosen
    assert shown == ["epoch", "final/AP50", "final/IoU", "final/best", "final/mIoU"]
    for stage, row in by_stage.items():
        found = {value.name.tag: value.value for value in row.metric_values}
        summary = read_json(newest(runs, f"{stage}/*/metrics.json"))
        assert found["final/best"] == pytest.approx(summary["best"]["value"])
        for name in ("AP50", "mIoU") if stage == "full" else ("AP50",):
            assert found[f"final/{name}"] == pytest.approx(summary["metrics"][f"val/{name}"])


def test_a_resumed_run_is_described_once(runs, streets, tmp_path):
    given = ("stage=pretrain", *SHORT, *STREETS, f"data.root={streets}", f"outputs={runs}")
    place = f"hydra.run.dir={tmp_path}/run"
    longer = ("trainer.max_epochs=2", "trainer.log_every_n_steps=1", "resume=auto")
    assert program("train", *given, *longer, place) == 0
    rows, _ = session_groups(tmp_path)
    assert len(rows) == 1
    events = EventAccumulator(str(tmp_path / "run/tensorboard"), {"tensors": 0}).Reload()
    (described,) = events.Tensors("configuration/text_summary")
    assert described.step == 1
    assert [each.step for each in events.Scalars("final/AP50")] == [2]
    losses = {"loss", "loss_detection", "loss_auxiliary", "loss_proposal"}
    assert sections(events) == losses | {"val", "final", "epoch", "optim", "time"}
    figures = [name for name in events.Tags()["scalars"] if name.startswith("loss/")]
    *parts, total = [events.Scalars(name)[-1].value for name in sorted(figures)]
    assert sum(parts) == pytest.approx(total, rel=1e-5)
