"""The loaders of training, evaluation and prediction."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from occdetr.data import cache, datamodule
from occdetr.data.augment import Augmentation
from occdetr.data.datamodule import Loading, SceneDataModule
from occdetr.data.dataset import NetworkInput
from occdetr.data.objects import ObjectSettings
from occdetr.errors import InputError
from occdetr.streets.datamodule import SyntheticDataModule
from occdetr.streets.writer import GENERATOR_VERSION
from scene_factory import REAL_ROOT, REAL_SEQUENCES, write_dataset

MODEL_SIZE = (64, 208)
EVERY_PIXEL = ObjectSettings(ray_stride=1)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_dataset(tmp_path, "00", num_frames=5)
    write_dataset(tmp_path, "08", num_frames=3)
    return tmp_path


def module(root: Path, **keywords) -> SceneDataModule:
    settings = {
        "root": root,
        "image_size": list(MODEL_SIZE),
        "train_sequences": ["00"],
        "test_sequences": ["08"],
        "strides": [8, 16],
        "objects": EVERY_PIXEL,
    }
    return SceneDataModule(**(settings | keywords))


def test_loaders(root: Path) -> None:
    scenes = module(root, batch_size=2)
    scenes.setup("fit")
    assert scenes.summary("train").startswith("train: 5 frames (sequence 00, stride 5)")
    train = list(scenes.train_dataloader())
    assert sorted(len(batch) for batch in train) == [1, 2, 2]  # nothing is dropped
    assert sorted(torch.cat([batch.frame_indices for batch in train]).tolist()) == [*range(5)]
    val = list(scenes.val_dataloader())
    assert [name for batch in val for name in batch.frame_ids] == [
        "08/000000",
        "08/000005",
        "08/000010",
    ]
    assert all(batch.targets is not None and batch.labels is not None for batch in val)
    scenes.setup("predict")
    predict = next(iter(scenes.predict_dataloader()))
    assert predict.labels is None
    assert predict.targets is None
    assert (root / cache.CACHE_FOLDER).is_dir()


def test_training_repeats_its_frames_and_passes_over_other_folders(
    root: Path, tmp_path: Path
) -> None:
    """Whose held-out sequences stay out, and whose labels do not mix with those of sequences of the
    same name."""
    extra = [tmp_path / "a" / "streets", tmp_path / "b" / "streets"]
    for folder in extra:
        write_dataset(folder, "00", num_frames=2)
        write_dataset(folder, "08", num_frames=1)
    write_dataset(extra[1], "31", num_frames=1)
    scenes = module(root, repeats=3, extra_roots=extra)
    scenes.setup("fit")
    text = scenes.training_summary()
    assert f"each 3 times an epoch, and 5 in {extra[0]}, {extra[1]}" in text
    assert "epoch" not in scenes.summary("train")  # which evaluations print
    names = [name for batch in scenes.train_dataloader() for name in batch.frame_ids]
    assert len(names) == 3 * 5 + 5
    assert {names.count(f"00/{number:06d}") for number in range(0, 25, 5)} == {3}
    assert len(set(names)) == 5 + 5
    others = [name for name in names if name.startswith("streets-")]
    assert sorted(name.split("/", 1)[1] for name in others) == [
        *("00/000000", "00/000000", "00/000005", "00/000005", "31/000000")
    ]
    again = module(root, repeats=3, extra_roots=extra)
    assert again.prepare_objects(("train",), progress=False).built == 0
    for split, count in (("train", 5), ("val", 3)):  # evaluated without repeats
        assert (
            len(
                list(module(root, repeats=3, extra_roots=extra, eval_split=split).test_dataloader())
            )
            == count
        )


def test_another_number_of_frames_after_an_interruption_is_reported(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dataset(tmp_path / "extra", "00", num_frames=2)
    state = {"epoch": 1, "frames": 2, "batches": 2}
    scenes = module(root, extra_roots=[tmp_path / "extra"])
    for saved in (state, {**state, "epoch_frames": 7}):
        scenes.load_state_dict(saved)
        assert not capsys.readouterr().out
    scenes.load_state_dict({**state, "epoch_frames": 5})
    assert "note: an epoch has 7 frames now, and had 5 before" in capsys.readouterr().out
    assert scenes.position.epoch == 1


def test_frames_of_validation_in_another_folder_are_reported(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also behind a link under another name."""
    (tmp_path / "links" / "sequences").mkdir(parents=True)
    (tmp_path / "links" / "sequences" / "40").symlink_to(root / "sequences" / "08")
    module(root, extra_roots=[tmp_path / "links"]).setup("fit")
    assert "note: 3 frames are in train and in val" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("settings", "facts"),
    [
        ({"extra_roots": "a"}, "data.extra_roots=a: give a list"),
        ({"extra_roots": ["none"]}, "data.extra_roots: there is no folder none"),
        ({"extra_roots": [__file__]}, "data.extra_roots=.*is a file"),
        ({"extra_roots": ["a", "b/../a"]}, "data.extra_roots=.*: a is given twice"),
        ({"repeats": 0}, "data.repeats=0"),
    ],
)
def test_wrong_extra_folders(root: Path, settings: dict, facts: str) -> None:
    with pytest.raises(InputError, match=facts):
        module(root, **settings).setup("fit")


def test_every_rank_stops_if_an_extra_folder_is_missing(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(datamodule, "_rank_and_world_size", lambda trainer: (1, 2))
    with pytest.raises(InputError, match=r"data\.extra_roots"):
        module(root, extra_roots=["none"]).setup("fit")


def test_root_is_no_extra_folder(root: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(root)
    with pytest.raises(InputError, match=r"data.extra_roots=.*or is data.root"):
        module(root, extra_roots=[tmp_path / "link"])


def test_level_below_an_extra_folder(root: Path, tmp_path: Path) -> None:
    write_dataset(tmp_path / "a", "00", num_frames=1)
    with pytest.raises(InputError, match=r"set data.extra_roots=\[.*a\]"):
        module(root, extra_roots=[tmp_path / "a" / "sequences"]).setup("fit")


def test_extra_folder_of_held_out_sequences_alone(root: Path, tmp_path: Path) -> None:
    write_dataset(tmp_path / "held_out", "08", num_frames=1)
    with pytest.raises(InputError, match=r"data.extra_roots=.*no sequence besides 08"):
        module(root, extra_roots=[tmp_path / "held_out"]).setup("fit")


def test_batches_do_not_depend_on_the_number_of_workers(root: Path) -> None:
    batches = []
    for num_workers in (0, 2):
        scenes = module(root, num_workers=num_workers, flip=0.5, photometric=0.4)
        loader = scenes.train_dataloader()
        loader.sampler.set_epoch(3)  # pyright: ignore[reportAttributeAccessIssue]
        batches.append(list(loader))
    for alone, worked in zip(*batches, strict=True):
        assert alone.frame_ids == worked.frame_ids
        assert torch.equal(alone.images, worked.images)
        assert torch.equal(alone.labels, worked.labels)


def test_only_training_is_augmented(root: Path) -> None:
    scenes = module(root, flip=1.0, train_sequences=["00"], val_sequences=["00"])
    train = {batch.frame_ids[0]: batch for batch in scenes.train_dataloader()}
    for batch in scenes.val_dataloader():
        assert torch.equal(batch.images.flip(-1), train[batch.frame_ids[0]].images)
        assert not torch.equal(batch.images, train[batch.frame_ids[0]].images)


def test_evaluation_takes_the_train_or_val_split(root: Path) -> None:
    for split, count in (("train", 5), ("val", 3)):
        scenes = module(root, eval_split=split)
        scenes.setup("test")
        assert len(list(scenes.test_dataloader())) == count
    with pytest.raises(InputError, match="eval_split=test"):
        module(root, eval_split="test")


@pytest.mark.parametrize("stage", ["fit", "validate", "test"])
def test_every_process_needs_a_frame_to_evaluate(
    root: Path, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There are 3 frames to evaluate."""
    monkeypatch.setattr(datamodule, "_rank_and_world_size", lambda trainer: (0, 3))
    module(root).setup(stage)
    monkeypatch.setattr(datamodule, "_rank_and_world_size", lambda trainer: (0, 4))
    with pytest.raises(InputError, match=r"trainer\.devices: 4 processes for val: 3 frames"):
        module(root).setup(stage)


def test_images_can_be_exchanged(root: Path) -> None:
    """Labels stay, and every frame has another frame's image; with one frame it is an error."""
    own, exchanged = (
        list(module(root, exchange_images=value).test_dataloader()) for value in (False, True)
    )
    images = {batch.frame_ids[0]: batch.images for batch in own}
    for before, after in zip(own, exchanged, strict=True):
        assert before.frame_ids == after.frame_ids
        assert torch.equal(before.labels, after.labels)
        assert not torch.equal(before.images, after.images)
        assert any(torch.equal(after.images, image) for image in images.values())
    alone = module(root, exchange_images=True, val_sequences=["00"], stride=1000)
    with pytest.raises(InputError, match="2 frames or more"):
        alone.test_dataloader()


@pytest.mark.parametrize(
    ("keywords", "word"),
    [
        ({"batch_size": 0}, "batch_size=0"),
        ({"num_workers": -1}, "num_workers=-1"),
        ({"flip": 1.5}, "flip=1.5"),
        ({"photometric": 1.0}, "photometric=1.0"),
        ({"stride": 0}, "stride=0"),
        (
            {"training_heights": None},
            "training_heights: SceneDataModule.* add '~data.training_heights'",
        ),
    ],
)
def test_invalid_settings_are_reported(root: Path, keywords: dict, word: str) -> None:
    with pytest.raises(InputError, match=f"data.{word}"):
        module(root, **keywords)


def test_missing_sequences_are_reported_at_setup(root: Path) -> None:
    with pytest.raises(InputError, match="sequence 03 is missing"):
        module(root, train_sequences=["03"]).setup("fit")


def test_prepared_objects_are_not_built_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = module(root)
    done = scenes.prepare_objects(progress=False)
    assert (done.built, done.reused, done.objects) == (8, 0, 16)
    monkeypatch.setattr(cache, "extract_objects", lambda *args: pytest.fail("built again"))
    assert len(list(scenes.train_dataloader())) == 5


def test_synthetic_streets_are_written_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    streets = SyntheticDataModule(
        num_train=2,
        num_val=1,
        root=tmp_path / "streets",
        seed=5,
        street_image_size=[96, 320],
        write_workers=1,
        image_size=list(MODEL_SIZE),
        batch_size=2,
    )
    streets.prepare_data()
    files = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.label")}
    assert len(files) == 3
    streets.setup("fit")
    batch = next(iter(streets.train_dataloader()))
    assert len(batch) == 2
    assert batch.images.shape == (2, 3, *MODEL_SIZE)
    assert len(list(streets.val_dataloader())) == 1
    streets.prepare_data()
    assert files == {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.label")}
    assert f"streets-v{GENERATOR_VERSION}" in str(streets.labels.root)
    assert f"generator version {GENERATOR_VERSION}, seed 5" in streets.summary("train")


def test_a_file_in_place_of_the_cache_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for place in ("file", "file/cache"):
        with pytest.raises(InputError, match=r"data\.cache_dir=.*/file is a file"):
            SceneDataModule(root=tmp_path, cache_dir=tmp_path / place)


# real frames


@pytest.mark.skipif(not REAL_ROOT.is_dir(), reason="no real frames here")
def test_real_frames_load(tmp_path: Path) -> None:
    scenes = SceneDataModule(
        root=REAL_ROOT,
        train_sequences=REAL_SEQUENCES,
        cache_dir=tmp_path,
        batch_size=4,
        image_size=[128, 416],
    )
    count, objects = 0, 0
    for batch in scenes.train_dataloader():
        count += len(batch)
        assert torch.isfinite(batch.images).all()
        assert batch.targets is not None
        objects += sum(len(target) for target in batch.targets)
        assert batch.labels is not None
        assert set(batch.labels.unique().tolist()) <= {*range(20), 255}
    assert count == 20
    assert objects > 150
    assert os.listdir(tmp_path)


def test_labels_need_no_network(root: Path) -> None:
    """Without an image size objects can be prepared, and loaders name the missing setting."""
    scenes = SceneDataModule(EVERY_PIXEL, root=root, train_sequences=["00"])
    assert scenes.prepare_objects(progress=False).built == 8
    with pytest.raises(InputError, match=r"data\.image_size"):
        scenes.train_dataloader()


def test_settings_are_grouped(root: Path) -> None:
    flat = module(root, batch_size=3, flip=0.5, scale=[1, 2], eval_split="train", stride=10)
    assert flat.folder.stride == 10
    assert flat.loading == Loading(batch_size=3)
    assert flat.augmentation == Augmentation(flip=0.5, scale=(1.0, 2.0))
    assert flat.evaluated.eval_split == "train"
    assert flat.network == NetworkInput(MODEL_SIZE, [8, 16])
    assert flat.labels.settings == EVERY_PIXEL
    with pytest.raises(InputError, match="flop"):
        module(root, flop=0.5)
