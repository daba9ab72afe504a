"""The Python interface: a model as a function, and its results as files."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

import occdetr
from occdetr.api.model import Model, Prepared, _first_of_doubles
from occdetr.classes import CLASS_COLORS, CLASS_NAMES
from occdetr.data.semantickitti import read_raw_labels
from occdetr.errors import InputError
from occdetr.geometry.voxels import GRID_SHAPE, points_to_indices
from occdetr.models.inference import Prediction


@pytest.fixture(scope="module")
def model(varied_checkpoint) -> Model:
    return occdetr.load(varied_checkpoint, device="cpu", score_threshold=0.0)


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def result(model, photo) -> occdetr.Result:
    return model(photo, occdetr.Camera.from_fov(75, height=1.5))


def test_a_photo_gives_objects_in_its_own_pixels_and_a_grid(result, photo) -> None:
    assert result.grid.shape == GRID_SHAPE
    assert 0.3 < (result.grid == 255).mean() < 0.8  # what the photo does not show
    assert len(result.boxes) == len(result.boxes3d) == len(result.scores) > 0
    assert (np.diff(result.scores) <= 0).all()
    assert (result.boxes >= -0.5).all()
    assert (result.boxes <= np.tile([639.5, 479.5], 2)).all()
    assert result.class_names == [CLASS_NAMES[index] for index in result.classes]
    assert result.image is photo


def test_every_voxel_that_is_known_has_a_probability(result) -> None:
    unknown = result.grid == 255
    assert np.isnan(result.probabilities[unknown]).all()
    known = result.probabilities[~unknown]
    assert ((known >= 0) & (known <= 1)).all()
    written = result.probabilities[~unknown & (result.grid > 0)]
    assert written.min() > 0
    assert written.mean() > 2 * known.mean()


def test_files_and_arrays_give_the_same(model, result, photo, tmp_path) -> None:
    file = tmp_path / "photo.png"
    cv2.imwrite(str(file), photo[..., ::-1])
    again = model(file, occdetr.Camera.from_fov(75, height=1.5))
    np.testing.assert_array_equal(again.grid, result.grid)
    np.testing.assert_array_equal(again.boxes, result.boxes)
    assert (again.name, result.name) == ("photo.png", "")


def test_results_are_read_back_from_their_files(result, tmp_path) -> None:
    for kind in ("png", "label", "npz", "ply"):
        result.save(tmp_path / f"a.{kind}")
    known = np.where(result.grid == 255, 0, result.grid)
    raw = read_raw_labels(tmp_path / "a.label")
    np.testing.assert_array_equal(raw > 0, known > 0)
    with np.load(tmp_path / "a.npz") as arrays:
        np.testing.assert_array_equal(arrays["grid"], result.grid)
        np.testing.assert_array_equal(arrays["probabilities"], result.probabilities)
        np.testing.assert_array_equal(arrays["boxes3d"], result.boxes3d)
        assert arrays["class_names"][9] == "road"
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\n")
    kinds = [*((axis, "<f4") for axis in "xyz"), ("color", "u1", 3), ("class", "u1")]
    points = np.frombuffer(body, np.dtype(kinds))
    assert f"element vertex {len(points)}\n".encode() in header
    index = points_to_indices(np.stack([points["x"], points["y"], points["z"]], axis=1))
    written = np.zeros(GRID_SHAPE, np.uint8)
    written[tuple(index.T)] = points["class"]
    np.testing.assert_array_equal(written, known)
    np.testing.assert_array_equal(points["color"], CLASS_COLORS[points["class"]])
    assert cv2.imread(str(tmp_path / "a.png")).shape[1] == 1280
    with pytest.raises(InputError, match=r"a\.obj: give a file with \.png, \.label, \.npz, \.ply"):
        result.save(tmp_path / "a.obj")


def test_doubles_are_merged_within_a_class() -> None:
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [1, 0, 11, 10], [30, 0, 40, 10.0]])
    classes, scores = np.array([1, 1, 6, 1]), np.array([0.9, 0.8, 0.7, 0.6])
    assert _first_of_doubles(boxes, classes, scores, 0.6).tolist() == [0, 2, 3]
    assert _first_of_doubles(boxes, classes, scores, 0.95).tolist() == [0, 1, 2, 3]
    assert _first_of_doubles(boxes[:0], classes[:0], scores[:0], 0.6).tolist() == []


def test_objects_that_two_views_show_are_one(model, photo) -> None:
    """A 130 degree photo has three views, which overlap."""
    prepared = model.prepare(photo, occdetr.Camera.from_fov(130))
    assert len(prepared.views) == 3
    found, place = [], np.array([9.0, 1.0, -1.0])
    for view in prepared.views:
        height, width = view.camera.image_size
        local = np.linalg.inv(view.to_vehicle) @ [*place, 1]
        in_camera = (view.camera.lidar_to_camera @ local)[:3]
        pixel = view.camera.projection[:, :3] @ in_camera
        u, v = pixel[:2] / pixel[2]
        inside = pixel[2] > 0 and 0 < u < width and 0 < v < height
        count = int(inside)
        half = 40 / max(pixel[2], 1)
        found.append(
            Prediction(
                np.full(GRID_SHAPE, 9, np.uint8),
                np.array([[u - half, v - half, u + half, v + half]])[:count],
                np.concatenate([in_camera, [2.0, 1.5, 4.0]])[None][:count],
                np.array([1])[:count],
                np.array([0.8])[:count],
                np.full(GRID_SHAPE, 0.5, np.float32),
            )
        )
    assert sum(len(each.classes) for each in found) >= 2
    together = model._together(prepared, found)
    assert len(together.classes) == 1
    np.testing.assert_allclose(together.boxes3d[0, :3], place, atol=0.3)


def test_a_folder_of_a_run_is_its_best_checkpoint(checkpoint, tmp_path) -> None:
    found = occdetr.load(checkpoint.parent, device="cpu")
    trained = torch.load(checkpoint.parent / "best.ckpt", weights_only=True)["state_dict"]
    for name, value in found.network.state_dict().items():
        assert torch.equal(value, trained[f"model.{name}"])
    with pytest.raises(InputError, match=r"has neither best\.ckpt nor last\.ckpt"):
        occdetr.load(tmp_path)
    with pytest.raises(InputError, match="device=tpu"):
        occdetr.load(checkpoint, device="tpu")


@pytest.mark.parametrize("image", [np.zeros((10, 10, 3)), np.zeros((10, 10), np.uint8)])
def test_what_is_no_image_is_refused(model, image) -> None:
    with pytest.raises(InputError, match="give RGB bytes of shape"):
        model(image, occdetr.Camera.from_fov(90))


def test_an_image_without_objects_has_a_grid(checkpoint, photo) -> None:
    model = occdetr.load(checkpoint, device="cpu", score_threshold=1.0)

    class Picture:  # as PIL's images are
        def __array__(self, dtype=None, copy=None) -> np.ndarray:
            return photo

    found = model(Picture(), occdetr.Camera.from_fov(75))  # type: ignore
    assert found.boxes.shape == (0, 4)
    assert found.boxes3d.shape == (0, 6)


def test_a_camera_that_sees_nothing_of_the_grid_is_refused(model, photo) -> None:
    with pytest.raises(InputError, match="sees nothing of the grid"):
        model(photo, occdetr.Camera.from_fov(60, yaw=180))


def test_show_outside_of_a_notebook_says_what_to_do(result) -> None:
    with pytest.raises(InputError, match="save"):
        result.show()


def test_prepared_views_need_no_network(model, photo) -> None:
    prepared = model.prepare(photo, occdetr.Camera.from_fov(60), "a.png")
    assert isinstance(prepared, Prepared)
    assert [item.frame_id for item in prepared.items] == ["a.png"]
