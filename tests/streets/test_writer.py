"""Synthetic streets: reproducible, complete, and consistent between picture and labels."""

import json

import numpy as np
import pytest

from occdetr.classes import CLASS_NAMES, IGNORE
from occdetr.data.frames import find_frames
from occdetr.data.semantickitti import read_labels, read_mask
from occdetr.errors import InputError
from occdetr.files import read_image
from occdetr.geometry.camera import project_points, transform_points
from occdetr.geometry.kitti import read_calibration
from occdetr.geometry.raycast import camera_rays, cast_rays, metres_to_voxels
from occdetr.geometry.voxels import voxel_centers
from occdetr.streets import writer as synthetic
from occdetr.streets.moment import Camera, World

SIZE = (64, 208)
CAMERA = Camera(SIZE)


@pytest.fixture(scope="module")
def frame():
    return synthetic.make_frame(seed=0, split=0, index=7, camera=CAMERA)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("streets")
    written = synthetic.write_streets(folder, 3, 1, seed=5, camera=CAMERA, progress=False)
    assert written == 4
    return folder


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_same_seed_same_frame_other_split_or_index_another(frame):
    again = synthetic.make_frame(0, 0, 7, camera=CAMERA)
    np.testing.assert_array_equal(again.image, frame.image)
    np.testing.assert_array_equal(again.scan.labels, frame.scan.labels)
    np.testing.assert_array_equal(again.scan.invalid, frame.scan.invalid)
    for other in ((0, 1, 7), (0, 0, 8), (1, 0, 7)):
        assert (synthetic.make_frame(*other, camera=CAMERA).scan.labels != frame.scan.labels).any()


def test_worlds_do_not_depend_on_the_image_size(frame):
    larger = synthetic.make_frame(0, 0, 7, camera=Camera((96, 312)))
    assert larger.image.shape == (96, 312, 3)
    np.testing.assert_array_equal(larger.scan.labels, frame.scan.labels)
    np.testing.assert_array_equal(larger.scan.hits, frame.scan.hits)


def test_masks_are_as_semantickittis(frame):
    """In the real files what is labelled or invalid is occluded, and nothing invalid labelled."""
    scan = frame.scan
    assert not scan.labels[scan.invalid].any()
    assert scan.occluded[scan.invalid].all()
    assert scan.occluded[scan.labels > 0].all()
    assert scan.hits.sum() > 1000
    assert (scan.labels[scan.hits] > 0).all()
    assert 0.02 < (scan.labels > 0).mean() < 0.10
    assert 0.5 < (~scan.invalid).mean() < 0.95
    assert 0.3 < scan.occluded.mean() < 0.8


def test_nothing_filled_is_called_empty():
    moment = World(0, 0, 7).moment()
    voxels = moment.voxels()
    scan = moment.sweep(voxels)
    wrong = (voxels.classes > 0) & (scan.labels == 0) & ~scan.invalid
    assert not wrong.any()


def test_all_classes_appear():
    present = np.zeros(20, dtype=int)
    for index in range(40):
        moment = World(3, 0, index).moment()
        present[np.unique(moment.voxels().classes)] += 1
    rare = [name for name, count in zip(CLASS_NAMES, present, strict=True) if count < 2]
    assert not rare


def test_worlds_differ_where_the_road_is():
    """The most frequent class of a voxel must not be the answer."""
    roads = []
    for index in range(12):
        classes = World(4, 0, index).moment().voxels().classes
        roads.append((classes == CLASS_NAMES.index("road")).any(axis=2))
    share = np.mean(roads, axis=0)
    assert (share > 0.9).mean() < 0.15
    assert ((share > 0.1) & (share < 0.9)).mean() > 0.2


def test_labels_project_onto_the_things_in_the_picture(frame):
    """Project voxel centres with the pinhole camera; rays through those pixels must hit them."""
    labels, calibration = frame.scan.labels, frame.calibration
    voxels = np.argwhere(labels == CLASS_NAMES.index("car"))
    camera_points = transform_points(voxel_centers(voxels), calibration.lidar_to_camera)
    pixels, depth = project_points(camera_points, calibration.projection)
    height, width = SIZE
    u, v = np.round(pixels).astype(int).T
    inside = (depth > 1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    assert inside.sum() > 30

    origins, directions = camera_rays(calibration.projection, calibration.lidar_to_camera, SIZE)
    hits, distances, _ = cast_rays(labels > 0, metres_to_voxels(origins), directions)
    distances = distances.reshape(SIZE)[v[inside], u[inside]] * 0.2
    hits = hits.reshape(*SIZE, 3)[v[inside], u[inside]]
    ranges = np.linalg.norm(voxel_centers(voxels[inside]) - origins[0], axis=1)
    in_front = np.abs(distances - ranges) < 0.6  # not hidden by something nearer
    assert in_front.sum() > 10
    close = np.linalg.norm(hits[in_front] - voxels[inside][in_front], axis=1) <= 4
    assert close.mean() > 0.95


def test_left_is_left_and_up_is_up(frame):
    """Objects at positive y lie in the left half of the picture, high ones in the upper half."""
    calibration = frame.calibration
    points = np.array([[20.0, 8.0, 0.0], [20.0, -8.0, 0.0], [20.0, 0.0, 3.0], [20.0, 0.0, -1.5]])
    camera_points = transform_points(points, calibration.lidar_to_camera)
    pixels, _ = project_points(camera_points, calibration.projection)
    assert pixels[0, 0] < SIZE[1] / 2 < pixels[1, 0]
    assert pixels[2, 1] < SIZE[0] / 2 < pixels[3, 1]


def test_written_files_read_back(root):
    frames = find_frames(root, synthetic.street_sequences(3), stride=5)
    assert [f.id for f in frames] == ["00/000000", "01/000000", "02/000000"]
    expected = synthetic.make_frame(5, 0, 1, camera=CAMERA)
    labels = read_labels(frames[1])
    np.testing.assert_array_equal(labels == IGNORE, expected.scan.invalid)
    np.testing.assert_array_equal(
        labels[~expected.scan.invalid], expected.scan.labels[~expected.scan.invalid]
    )
    np.testing.assert_array_equal(read_image(frames[1].image), expected.image)
    np.testing.assert_array_equal(read_mask(frames[1].voxel_file("bin")), expected.scan.hits)
    calibration = read_calibration(frames[1].calibration)
    np.testing.assert_array_equal(calibration.projection, expected.calibration.projection)
    assert len(find_frames(root, ["08"], stride=5)) == 1
    assert (root / "sequences/00/poses.txt").read_text().count("\n") == 5


def test_rerun_writes_only_what_is_missing(root):
    before = contents(root)
    assert synthetic.write_streets(root, 3, 1, seed=5, camera=CAMERA, progress=False) == 0
    (root / "sequences/02/voxels/000000.invalid").unlink()
    assert synthetic.write_streets(root, 3, 1, seed=5, camera=CAMERA, progress=False) == 1
    assert contents(root) == before


def test_processes_do_not_change_the_files(root, tmp_path):
    synthetic.write_streets(tmp_path, 3, 1, seed=5, num_workers=4, camera=CAMERA, progress=False)
    assert contents(tmp_path) == contents(root)


def test_a_set_can_grow(root, tmp_path):
    synthetic.write_streets(tmp_path, 1, 0, seed=5, camera=CAMERA, progress=False)
    assert synthetic.write_streets(tmp_path, 3, 1, seed=5, camera=CAMERA, progress=False) == 3
    assert contents(tmp_path) == contents(root)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    settings = {"seed": 5, "camera": CAMERA, "scans_per_world": 7, "progress": False}
    assert synthetic.write_streets(folder, 2, 2, **settings) == 2
    return folder


def test_a_drive_has_pictures_at_10_hertz_and_voxels_at_every_fifth(drive):
    sequence = drive / "sequences/00"
    pictures = sorted(path.name for path in (sequence / "image_2").iterdir())
    assert pictures == [f"{number:06d}.png" for number in range(7)]
    assert sorted(path.name for path in (sequence / "voxels").glob("*.label")) == [
        "000000.label",
        "000005.label",
    ]
    assert len(find_frames(drive, ["00"], stride=5)) == 2
    times = np.loadtxt(sequence / "times.txt")
    np.testing.assert_allclose(np.diff(times), 0.1)
    assert len(times) == len(np.loadtxt(sequence / "poses.txt")) == 10


def test_poses_bring_one_frame_onto_the_next(drive):
    """What stands still lies where the poses of ``poses.txt`` say, frame after frame."""
    frames = find_frames(drive, ["00"], stride=5)
    rows = np.loadtxt(drive / "sequences/00/poses.txt").reshape(-1, 3, 4)
    to_camera = read_calibration(frames[0].calibration).lidar_to_camera
    first, later = (np.vstack([rows[number], [0, 0, 0, 1]]) for number in (0, 5))
    np.testing.assert_allclose(first, np.eye(4), atol=1e-3)
    move = np.linalg.inv(to_camera) @ np.linalg.inv(first) @ later @ to_camera
    assert 0.5 * 3 < move[0, 3] < 0.5 * 14  # 3 to 14 m/s, forwards
    before, after = (read_labels(frame) for frame in frames)
    building = np.argwhere(after == CLASS_NAMES.index("fence"))
    building = np.concatenate([building, np.argwhere(after == CLASS_NAMES.index("building"))])
    points = transform_points(voxel_centers(building), move)
    cells = np.floor(metres_to_voxels(points)).astype(int)
    within = ((cells >= 1) & (cells < np.array(before.shape) - 1)).all(axis=1)
    assert within.sum() > 300
    around = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    kinds = after[tuple(building[within].T)]
    moved = [before[tuple((cells[within] + shift).T)] == kinds for shift in around]
    known = before[tuple(cells[within].T)] != IGNORE
    assert np.any(moved, axis=0)[known].mean() > 0.9
    stayed = [
        before[tuple(np.clip(building[within] + shift, 0, np.array(before.shape) - 1).T)] == kinds
        for shift in around
    ]
    assert np.any(stayed, axis=0)[known].mean() < np.any(moved, axis=0)[known].mean()


def test_worlds_of_a_sequence_lie_apart_in_its_poses(tmp_path):
    synthetic.write_streets(tmp_path, 11, 0, seed=5, camera=CAMERA, progress=False)
    poses = np.loadtxt(tmp_path / "sequences/00/poses.txt")
    assert len(poses) == 10  # two worlds of one scan each
    steps = np.linalg.norm(np.diff(poses[:, [3, 7, 11]], axis=0), axis=1)
    assert steps[4] > 900
    assert np.delete(steps, 4).max() < 1.5


def test_another_camera_sees_the_same_world():
    wide = synthetic.make_frame(0, 0, 7, camera=Camera((128, 256), horizontal_fov=120.0))
    assert wide.image.shape == (128, 256, 3)
    focal = wide.calibration.projection[0, 0]
    assert 2 * np.degrees(np.arctan(128 / focal)) == pytest.approx(120)
    narrow = synthetic.make_frame(0, 0, 7, camera=CAMERA)
    np.testing.assert_array_equal(wide.scan.labels, narrow.scan.labels)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 6}, "seed=5, not 6"),
        ({"camera": Camera((32, 100))}, "image_size"),
        ({"camera": Camera(SIZE, 90.0)}, "horizontal_fov=None, not 90"),
        ({"camera": Camera(SIZE, 170.0)}, "10 to 150 degrees"),
        ({"scans_per_world": 3}, "scans_per_world=1, not 3"),
        ({"scans_per_world": 6}, "multiple of 2"),
        ({"scans_per_world": 99}, "at most"),
        ({"num_train": 2}, "more than 2"),
        ({"num_val": -1}, "num_val=-1"),
    ],
)
def test_other_settings_are_refused_in_one_line(root, change, message):
    settings = {"num_train": 3, "num_val": 1, "seed": 5, "camera": CAMERA} | change
    with pytest.raises(InputError, match=message) as error:
        synthetic.write_streets(root, **settings, progress=False)
    assert "\n" not in str(error.value)


def test_foreign_folders_are_refused(tmp_path):
    (tmp_path / "real/sequences").mkdir(parents=True)
    with pytest.raises(InputError, match="not synthetic streets"):
        synthetic.write_streets(tmp_path / "real", 1, 0)
    (tmp_path / "streets.json").write_text("[1")
    with pytest.raises(InputError, match=r"streets\.json"):
        synthetic.write_streets(tmp_path, 1, 0)


def test_settings_are_noted(root):
    noted = json.loads((root / "streets.json").read_text())
    assert noted["generator_version"] == synthetic.GENERATOR_VERSION
    assert (noted["num_train"], noted["num_val"]) == (3, 1)
