"""Augmentation keeps image, camera, boxes and voxels consistent.

The colours of the test images encode the position of each pixel in the image file. A point that is
projected by the camera of an augmented item must find there the position to which the camera of the
file projects it.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.data.augment import (
    Augmentation,
    Window,
    change_sensor,
    crop_objects,
    crop_picture,
    draw_window,
    flip_objects,
    jitter_colors,
)
from occdetr.data.cache import ObjectCache
from occdetr.data.datamodule import SceneDataModule
from occdetr.data.dataset import NetworkInput, SceneDataset, SceneItem
from occdetr.data.early_matching import match_rois
from occdetr.data.frames import find_frames
from occdetr.data.objects import ObjectSettings, SceneObjects, extract_objects
from occdetr.data.semantickitti import write_labels
from occdetr.errors import InputError
from occdetr.files import write_image
from occdetr.geometry.camera import (
    MIN_DEPTH,
    Camera,
    crop_camera,
    flip_camera,
    transform_points,
    unproject,
)
from occdetr.geometry.rois import preset_rois
from occdetr.geometry.voxels import voxel_centers, voxels_to_metres
from scene_factory import (
    CAMERA,
    IMAGE_SIZE,
    empty_grid,
    project_brute_force,
    put_box,
    street,
    write_dataset,
)

CAR = CLASS_NAMES.index("car")
SETTINGS = ObjectSettings(ray_stride=1)
MODEL_SIZE = (64, 208)
STRIDES = (8, 16)
AUGMENTATIONS = {
    "flip": {"flip": 1.0},
    "scale and crop": {"scale": (1.3, 1.3)},
    "any scale": {"scale": (1.0, 2.5)},
    "all": {"scale": (1.0, 1.5), "flip": 0.5},
}


def scene() -> np.ndarray:
    """A street with hidden and partly hidden objects and objects at every border of the image."""
    labels = street()
    put_box(labels, "truck", (9.0, -4.6, 0.0), (6.0, 2.0, 3.0))
    put_box(labels, "car", (8.0, 6.6, -1.0), (4.0, 1.8, 1.4))
    put_box(labels, "car", (30.0, -9.0, -0.8), (4.0, 1.8, 1.6))
    put_box(labels, "building", (26.0, -8.0, 0.0), (0.2, 2.4, 4.0))
    put_box(labels, "person", (22.0, 3.0, -0.8), (0.4, 0.4, 1.8))  # behind the car
    for step in range(12):  # a slanted object, which fills little of its box
        put_box(labels, "other-vehicle", (12.0, -1.0 + 0.2 * step, -1.2 + 0.2 * step), (0.4,) * 3)
    return labels


def position_image() -> np.ndarray:
    """Red increases by 1 per column in the left half, green in the right half, blue by 2 per
    row."""
    v, u = np.mgrid[0 : IMAGE_SIZE[0], 0 : IMAGE_SIZE[1]]
    middle = IMAGE_SIZE[1] // 2
    return np.stack([u.clip(0, middle), u.clip(middle) - middle, 2 * v], -1).astype(np.uint8)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two sequences with the same frame; the image of 01 is the negative."""
    for sequence, image in (("00", position_image()), ("01", 255 - position_image())):
        frame = write_dataset(tmp_path, sequence, num_frames=1)[0]
        write_image(frame.image, image)
        write_labels(frame.voxel_file("label"), scene())
    return tmp_path


def dataset(
    root: Path,
    size: tuple[int, int] = MODEL_SIZE,
    sequence: str = "00",
    labels: bool = True,
    seed: int = 0,
    **augmentation,
) -> SceneDataset:
    return SceneDataset(
        find_frames(root, [sequence]),
        NetworkInput(size, STRIDES, 2.0),
        ObjectCache(SETTINGS, root / "cache") if labels else None,
        Augmentation(**augmentation),
        seed,
    )


def colors_of(item: SceneItem) -> np.ndarray:
    """An item's image with values from 0 to 255."""
    return item.image.numpy().transpose(1, 2, 0).astype(float)


def positions_at(pixels: np.ndarray, item: SceneItem, negative: SceneItem) -> np.ndarray:
    """The positions (u, v) that the colours of an augmented image encode at ``pixels``, bilinear.

    OpenCV rounds interpolated colours down by 0.13 on average; the mean with the negative cancels
    it.
    """
    colors = (colors_of(item) + 255 - colors_of(negative)) / 2
    at = pixels[:, ::-1].T
    red, green, blue = (map_coordinates(colors[..., channel], at, order=1) for channel in range(3))
    return np.stack([red + green, blue / 2], axis=1)


def project(points: np.ndarray, item: SceneItem) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and depths of grid-frame points by the item's own camera."""
    matrix = (item.camera.projection.double() @ item.camera.lidar_to_camera.double()).numpy()
    rows = np.c_[points, np.ones(len(points))] @ matrix.T
    return rows[:, :2] / rows[:, 2:], rows[:, 2]


def is_mirrored(item: SceneItem) -> bool:
    assert item.labels is not None
    return not np.array_equal(item.labels.numpy(), scene())


def points_in_view(count: int) -> np.ndarray:
    """Random points (grid frame, metres) that are uniform over the image file's pixels."""
    rng = np.random.default_rng(2)
    pixels = rng.uniform(0, 1, (count, 2)) * [IMAGE_SIZE[1] - 1, IMAGE_SIZE[0] - 1]
    points = unproject(pixels, rng.uniform(2, 50, count), CAMERA.projection)
    return transform_points(points, np.linalg.inv(CAMERA.lidar_to_camera))


@pytest.mark.parametrize("size", [MODEL_SIZE, (150, 500)])
@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_augmented_cameras_fit_the_augmented_images(
    root: Path, name: str, size: tuple[int, int]
) -> None:
    """Within 0.75 pixels of the image file for each point, and within 0.05 on average."""
    frames = dataset(root, size, **AUGMENTATIONS[name])
    negatives = dataset(root, size, "01", **AUGMENTATIONS[name])
    points = np.concatenate([voxel_centers(np.argwhere(scene())), points_in_view(20_000)])
    original, in_front = project_brute_force(points, CAMERA)
    mirrored = []
    for epoch in range(6):
        item, negative = frames[epoch, 0], negatives[epoch, 0]
        assert torch.equal(item.camera.projection, negative.camera.projection)
        mirrored.append(is_mirrored(item))
        pixels, _ = project(points * [1, -1, 1] if mirrored[-1] else points, item)
        border = 1 + size[1] / IMAGE_SIZE[1]  # interpolation is less exact there
        inside = (pixels > border).all(1) & (pixels < np.array(size[::-1]) - 1 - border).all(1)
        inside &= in_front > MIN_DEPTH
        assert inside.sum() > 1000
        errors = positions_at(pixels[inside], item, negative) - original[inside]
        assert np.abs(errors).max() < 0.75
        assert np.abs(errors[-inside[-20_000:].sum() :].mean(0)).max() < 0.05
    assert any(mirrored) == ("flip" in AUGMENTATIONS[name])


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_augmented_targets_fit_the_augmented_labels(root: Path, name: str) -> None:
    """Voxels keep their class, boxes bound their projection, and early matching follows."""
    frames, cut = dataset(root, **AUGMENTATIONS[name]), 0
    rois = preset_rois(MODEL_SIZE, STRIDES, 2.0)
    for epoch in range(6):
        item = frames[epoch, 0]
        target, labels = item.target, item.labels
        assert target is not None
        assert labels is not None
        assert len(target) >= 1
        for index, class_id in enumerate(target.classes):
            voxels = target.voxels[target.voxel_object == index].numpy()
            assert (labels[tuple(voxels.T)] == class_id).all()
            box, inside = box_of(voxels, item)
            np.testing.assert_allclose(target.boxes_cxcywh[index], box, atol=1e-4)
            cut += not inside
            lower, upper = voxels_to_metres(voxels.min(0)), voxels_to_metres(voxels.max(0) + 1)
            expected = [*(lower + upper) / 2, *upper - lower]
            np.testing.assert_allclose(target.boxes3d_grid[index], expected, atol=1e-4)
            center = item.camera.lidar_to_camera.double().numpy() @ [*expected[:3], 1.0]
            np.testing.assert_allclose(target.boxes3d_camera[index, :3], center[:3], atol=1e-4)
        matched = match_rois(target.boxes_cxcywh.numpy(), rois)
        assert np.array_equal(target.roi_indices, matched)
    assert cut >= 6


def box_of(voxels: np.ndarray, item: SceneItem) -> tuple[np.ndarray, bool]:
    """Normalised box of the part of an object in an item's image; whether that is all of it."""
    corners = np.stack([voxels + c for c in itertools.product((0, 1), repeat=3)], axis=1)
    pixels, depth = project(voxels_to_metres(corners).reshape(-1, 3), item)
    points = (pixels.reshape(-1, 8, 2) + 0.5) / [MODEL_SIZE[1], MODEL_SIZE[0]]
    lower, upper = points.min(1), points.max(1)
    in_front = (depth.reshape(-1, 8) > MIN_DEPTH).all(1)
    in_view = in_front & (upper > 0).all(1) & (lower < 1).all(1)
    low, high = lower[in_view].min(0).clip(0), upper[in_view].max(0).clip(None, 1)
    return np.concatenate([(low + high) / 2, high - low]), bool(in_view.all())


# windows


def crop(objects: SceneObjects, labels: np.ndarray, window: Window) -> SceneObjects:
    return crop_objects(objects, labels, window_camera(window), SETTINGS)


def window_camera(window: Window) -> Camera:
    return crop_camera(CAMERA, window.left, window.top, (window.height, window.width))


def test_cropped_objects_equal_those_of_the_windows_camera() -> None:
    """Cropping the objects of an image gives those extracted from the cropped image."""
    labels, dropped = scene(), 0
    objects = extract_objects(labels, CAMERA, SETTINGS)
    for seed in range(12):
        window = draw_window(IMAGE_SIZE, (1.2, 3.0), np.random.default_rng(seed))
        expected = extract_objects(labels, window_camera(window), SETTINGS)
        cropped = crop(objects, labels, window)
        for name, array in cropped.arrays().items():
            np.testing.assert_array_equal(array, expected.arrays()[name], err_msg=name)
        dropped += len(objects) - len(cropped)
    assert dropped > 12


def test_objects_are_dropped_with_their_last_visible_pixel() -> None:
    """The right half of a car is behind a wall, so a window on that half has no car."""
    labels = empty_grid()
    put_box(labels, "car", (20.0, 0.0, -0.8), (4.0, 4.0, 1.6))
    put_box(labels, "building", (17.0, -1.2, -0.5), (0.2, 2.4, 3.0))
    objects = extract_objects(labels, CAMERA, SETTINGS)
    assert objects.classes.tolist() == [CAR]
    assert 0.3 < objects.visible_fraction[0] < 0.7
    pixel = project_brute_force(np.array([[18.0, 0.0, -0.8]]), CAMERA)[0][0]
    middle = round(float(pixel[0]))
    left, right = Window(middle - 100, 0, 100, 120), Window(middle + 10, 0, 100, 120)
    seen = crop(objects, labels, left)
    assert seen.visible_fraction.tolist() == [1.0]
    assert np.array_equal(seen.voxels, objects.voxels)
    assert seen.boxes_cxcywh[0, 0] + seen.boxes_cxcywh[0, 2] / 2 == pytest.approx(1)
    hidden = project_brute_force(np.array([[18.0, -1.0, -0.8]]), CAMERA)[0][0]
    assert right.left < hidden[0] < right.left + right.width
    assert len(crop(objects, labels, right)) == 0


def test_objects_that_fill_the_window_are_dropped() -> None:
    labels = empty_grid()
    put_box(labels, "truck", (10.0, 0.0, 0.0), (2.0, 6.0, 4.0))
    objects = extract_objects(labels, CAMERA, SETTINGS)
    assert len(objects) == 1
    u, v = (
        project_brute_force(np.array([[9.0, 0.0, 0.0]]), CAMERA)[0][0].round().astype(int).tolist()
    )
    assert len(crop(objects, labels, Window(u - 20, v - 10, 40, 20))) == 0
    assert len(crop(objects, labels, Window(0, 0, IMAGE_SIZE[1], IMAGE_SIZE[0]))) == 1


def test_windows_are_uniform_in_place_and_scale() -> None:
    rng = np.random.default_rng(0)
    windows = np.array([draw_window((120, 400), (1.0, 1.6), rng) for _ in range(2000)])
    left, top, width, height = windows.T
    assert left.min() == top.min() == 0
    assert (left + width).max() == 400
    assert (top + height).max() == 120
    assert (width.min(), width.max()) == (250, 400)
    assert (height.min(), height.max()) == (75, 120)
    np.testing.assert_allclose(width / height, 400 / 120, rtol=0.01)
    assert abs(np.corrcoef(left / (401 - width), top / (121 - height))[0, 1]) < 0.1
    middle = (left[width < 300] + width[width < 300] / 2) / 400
    assert middle.mean() == pytest.approx(0.5, abs=0.02)
    assert draw_window((120, 400), (1.0, 1.0), rng) == (0, 0, 400, 120)
    image, camera = crop_picture(position_image(), CAMERA, Window(3, 5, 40, 20))
    assert image.shape == (20, 40, 3)
    assert camera.image_size == (20, 40)


# in training


def test_augmentation_depends_only_on_seed_epoch_and_frame(root: Path) -> None:
    def cameras(**keywords) -> list[list[float]]:
        frames = dataset(root, scale=(1.0, 1.5), flip=0.5, **keywords)
        return [frames[epoch, 0].camera.projection.flatten().tolist() for epoch in range(4)]

    first = cameras()
    assert first == cameras()
    assert len({tuple(camera) for camera in first}) == 4
    assert first != cameras(seed=1)


def test_frames_without_labels_are_cropped_too(root: Path) -> None:
    item = dataset(root, scale=(2.0, 2.0), labels=False)[0]
    assert item.target is None
    assert item.camera.projection[0, 0] == pytest.approx(
        2 * CAMERA.projection[0, 0] * 208 / 400, rel=1e-5
    )


def module(root: Path, **keywords) -> SceneDataModule:
    return SceneDataModule(
        root=root,
        image_size=MODEL_SIZE,
        objects=SETTINGS,
        strides=STRIDES,
        train_sequences=["00"],
        val_sequences=["00"],
        **keywords,
    )


def test_only_training_is_cropped(root: Path) -> None:
    """Windows need not contain the principal point: only complete images are checked for it."""
    scenes = module(root, scale=[4.0, 4.0])
    plain = module(root).dataset("train")[0]
    (validated,) = scenes.val_dataloader()
    assert torch.equal(validated.images[0], plain.image)
    outside = 0
    for epoch in range(8):
        loader = scenes.train_dataloader()
        loader.sampler.set_epoch(epoch)  # pyright: ignore[reportAttributeAccessIssue]
        (batch,) = loader
        (u, v), size = batch.camera.projection[0, :2, 2].tolist(), MODEL_SIZE
        outside += not (0 <= u < size[1] and 0 <= v < size[0])
        assert batch.targets is not None
    assert outside >= 4


@pytest.mark.parametrize(
    "scale",
    [[0.9, 1.2], [1.25, 1.0], [1.0, 4.5], [1.0], [1.0, 1.1, 1.2], [1.0, float("nan")], []],
)
def test_invalid_scales_are_reported(root: Path, scale: list[float]) -> None:
    with pytest.raises(InputError, match=r"data\.scale=\[.*give \[least, most\]") as error:
        module(root, scale=scale)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("data", ["synthetic", "semantickitti"])
def test_scale_is_off_by_default(data: str) -> None:
    config = cli.compose("train", [f"data={data}"])
    assert cli.build(config.data).augmentation.scale == (1.0, 1.0)
    config = cli.compose("train", [f"data={data}", "data.scale=[1.0,1.25]"])
    assert cli.build(config.data).augmentation.scale == (1.0, 1.25)


# flips and colours


def test_flipped_objects_equal_those_of_the_mirrored_labels() -> None:
    """The flipped objects are those extracted from mirrored labels with the flipped camera."""
    labels = street()
    put_box(labels, "truck", (20.0, -6.0, 0.0), (6.0, 2.4, 3.0))
    flipped = flip_objects(extract_objects(labels, CAMERA, SETTINGS))
    mirrored = np.ascontiguousarray(labels[:, ::-1])
    camera = flip_camera(CAMERA)
    expected = extract_objects(mirrored, camera, SETTINGS)
    assert len(flipped) == len(expected) == 3
    order, other = np.argsort(flipped.classes), np.argsort(expected.classes)
    for name in ("classes", "boxes_cxcywh", "boxes3d_camera", "boxes3d_grid"):
        ours, theirs = getattr(flipped, name)[order], getattr(expected, name)[other]
        np.testing.assert_allclose(ours, theirs, atol=1e-4, err_msg=name)
    np.testing.assert_allclose(
        flipped.visible_fraction[order], expected.visible_fraction[other], atol=0.03
    )
    voxel_classes = flipped.classes[flipped.voxel_object]
    assert (mirrored[tuple(flipped.voxels.T)] == voxel_classes).all()


def test_color_changes_are_limited_by_the_strength() -> None:
    image = np.full((4, 5, 3), (120, 100, 80), dtype=np.uint8)
    means = [jitter_colors(image, 0.2, np.random.default_rng(seed)).mean() for seed in range(50)]
    assert 79 < min(means) < 95
    assert 105 < max(means) < 121
    unchanged = jitter_colors(image, 0.0, np.random.default_rng(0))
    assert np.abs(unchanged.astype(int) - image).max() <= 1


def test_a_changed_sensor_keeps_the_picture() -> None:
    """Its edges stay where they are; colours, sharpness and noise differ with the strength."""
    columns = np.where(np.arange(40) < 20, 60, 180).astype(np.uint8)
    image = np.repeat(np.broadcast_to(columns, (30, 40))[..., None], 3, axis=2).copy()
    differences = {}
    for strength in (0.1, 1.0):
        found = [change_sensor(image, strength, np.random.default_rng(seed)) for seed in range(40)]
        for changed in found:
            assert changed.shape == image.shape
            assert changed.dtype == np.uint8
            edge = np.diff(changed.astype(int).mean((0, 2))).argmax()
            assert edge == 19
        balance = [np.ptp(changed.mean((0, 1))) for changed in found]
        sharpness = [np.diff(changed.astype(int).mean((0, 2))).max() for changed in found]
        noise = [changed[:, 5:15].std((0, 1)).mean() for changed in found]
        differences[strength] = np.array([np.std(values) for values in (balance, sharpness, noise)])
    assert (differences[1.0] > 2 * differences[0.1]).all()
    again = change_sensor(image, 1.0, np.random.default_rng(3))
    np.testing.assert_array_equal(again, change_sensor(image, 1.0, np.random.default_rng(3)))
