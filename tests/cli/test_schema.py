"""Types of settings: from ``Settings`` and from the annotations of constructors."""

from __future__ import annotations

import pytest

from occdetr.cli.entry import compose
from occdetr.cli.schema import check_types
from occdetr.errors import InputError


@pytest.mark.parametrize(
    "override",
    [
        "seed=1.5",
        "early_matching_share=all",
        "attention.hidden_dim=wide",
        "model.encoder.num_layers=two",
        "model.slots.num_slots=abc",
        "model.encoder.in_channels=64",
        "model.occupancy_decoder.background.kept=[1,2,many]",
        "loss.occupancy.unknown_weight=half",
        "optimizer.lr=fast",
        "scheduler.warmup_steps=0.5",
        "data.flip=often",
        "data.num_train=some",
        "data.objects.ray_stride=x",
        "trainer.max_epochs=true",
        "callbacks.pictures.num_frames=all",
    ],
)
def test_a_wrong_type_is_refused_by_the_name_of_its_setting(override):
    config = compose("train", ["stage=full", override])
    with pytest.raises(InputError, match="^" + override.split("=")[0]):
        check_types(config)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("model.slots.box_transform=axess", "bounds, axes"),
        ("model.fusion.interpolation=nearst", "trilinear, nearest"),
        ("loss.occupancy.background_voxels=all_of_them", "unclaimed, background, all"),
        ("loss.occupancy.objects.missed_boxes=drop", "skip, count"),
        ("optimizer.decay=al", "matrices, all"),
        ("query_content=foo", "token, learned"),
    ],
)
def test_a_word_that_is_no_option_is_refused_with_the_options(override, words):
    config = compose("train", ["stage=full", override])
    with pytest.raises(InputError, match=f"={override.split('=')[1]}: choose one of {words}$"):
        check_types(config)


@pytest.mark.parametrize(
    "override",
    [
        "trainer.devices=auto",
        "trainer.precision=16-mixed",
        "trainer.limit_train_batches=0.5",
        "trainer.limit_train_batches=3",
        "model.slots.enlargement=2",
        "model.occupancy_decoder.sight_dim=null",
        "data.cache_dir=somewhere",
        "callbacks=[default,early_stopping,ema]",
        "+trainer.callbacks={_target_: lightning.pytorch.callbacks.Timer}",
        "+data.objects.distance.car=1",
    ],
)
def test_a_right_type_is_accepted(override):
    config = compose("train", ["stage=full", override])
    before = config.copy()
    check_types(config)
    assert config == before  # checking converts nothing


@pytest.mark.parametrize("size", ["128", "[128]", "[128,0]", "[128,416.5]", "[128,true]"])
def test_an_image_size_is_two_positive_integers(size):
    with pytest.raises(InputError, match="image_size"):
        check_types(compose("train", [f"image_size={size}"]))
