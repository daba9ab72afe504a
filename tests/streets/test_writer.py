"""Synthetic streets are reproducible, complete, and consistent between images and labels."""

import json

import numpy as np
import pytest

from occdetr.classes import CLASS_NAMES, IGNORE
from occdetr.data.frames import find_frames
from occdetr.data.semantickitti import read_labels, read_mask
from occdetr.errors import InputError
from occdetr.files import read_image
from occdetr.geometry.camera import project_points, transform_points
from occdetr.geometry.kitti import kitti_camera, read_camera
from occdetr.geometry.raycast import camera_rays, cast_rays
from occdetr.geometry.voxels import metres_to_voxels, voxel_centers
from occdetr.streets.settings import StreetSettings
from occdetr.streets.world import World
from occdetr.streets.writer import GENERATOR_VERSION, make_frame, write_streets
from scene_factory import one_line_error

SIZE = (64, 208)
CAMERA = kitti_camera(SIZE)


def streets(num_train: int, num_val: int = 0, **settings) -> StreetSettings:
    return StreetSettings(num_train, num_val, **({"seed": 5, "street_image_size": SIZE} | settings))


@pytest.fixture(scope="module")
def frame():
    return make_frame(seed=0, split=0, index=7, camera=CAMERA)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("streets")
    written = write_streets(folder, streets(3, 1), progress=False)
    assert written == 4
    return folder


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_frames_depend_on_seed_split_and_index_alone(frame):
    again = make_frame(0, 0, 7, camera=CAMERA)
    np.testing.assert_array_equal(again.image, frame.image)
    np.testing.assert_array_equal(again.scan.labels, frame.scan.labels)
    np.testing.assert_array_equal(again.scan.invalid, frame.scan.invalid)
    for other in ((0, 1, 7), (0, 0, 8), (1, 0, 7)):
        assert (make_frame(*other, camera=CAMERA).scan.labels != frame.scan.labels).any()


def test_worlds_do_not_depend_on_the_image_size(frame):
    larger = make_frame(0, 0, 7, camera=kitti_camera((96, 312)))
    assert larger.image.shape == (96, 312, 3)
    np.testing.assert_array_equal(larger.scan.labels, frame.scan.labels)
    np.testing.assert_array_equal(larger.scan.hits, frame.scan.hits)


def test_masks_relate_as_in_semantickitti(frame):
    """Labelled and invalid voxels are occluded, and no invalid voxel is labelled."""
    scan = frame.scan
    assert not scan.labels[scan.invalid].any()
    assert scan.occluded[scan.invalid].all()
    assert scan.occluded[scan.labels > 0].all()
    assert scan.hits.sum() > 1000
    assert (scan.labels[scan.hits] > 0).all()
    assert 0.02 < (scan.labels > 0).mean() < 0.10
    assert 0.5 < (~scan.invalid).mean() < 0.95
    assert 0.3 < scan.occluded.mean() < 0.8


def test_filled_voxels_are_labelled_or_invalid():
    snapshot = World(0, 0, 7).snapshot()
    voxels = snapshot.voxels()
    scan = snapshot.sweep(voxels)
    wrong = (voxels.classes > 0) & (scan.labels == 0) & ~scan.invalid
    assert not wrong.any()


@pytest.fixture(scope="module")
def worlds():
    """The classes of the voxels of 20 worlds."""
    return [World(4, 0, index).snapshot().voxels().classes for index in range(20)]


def test_all_classes_appear(worlds):
    present = np.zeros(20, dtype=int)
    for classes in worlds:
        present[np.unique(classes)] += 1
    rare = [name for name, count in zip(CLASS_NAMES, present, strict=True) if count < 2]
    assert not rare


def test_the_road_is_elsewhere_in_other_worlds(worlds):
    """The position of a voxel alone must not determine its class."""
    roads = [(classes == CLASS_NAMES.index("road")).any(axis=2) for classes in worlds]
    share = np.mean(roads, axis=0)
    assert (share > 0.9).mean() < 0.15
    assert ((share > 0.1) & (share < 0.9)).mean() > 0.2


def test_voxels_are_hit_by_the_rays_of_their_pixels(frame):
    """Rays through the pixels to which voxel centres project hit these voxels."""
    labels, camera = frame.scan.labels, frame.camera
    voxels = np.argwhere(labels == CLASS_NAMES.index("car"))
    camera_points = transform_points(voxel_centers(voxels), camera.lidar_to_camera)
    pixels, depth = project_points(camera_points, camera.projection)
    height, width = SIZE
    u, v = np.round(pixels).astype(int).T
    inside = (depth > 1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    assert inside.sum() > 30

    origins, directions = camera_rays(camera)
    hits, distances, _ = cast_rays(labels > 0, metres_to_voxels(origins), directions)
    distances = distances.reshape(SIZE)[v[inside], u[inside]] * 0.2
    hits = hits.reshape(*SIZE, 3)[v[inside], u[inside]]
    ranges = np.linalg.norm(voxel_centers(voxels[inside]) - origins[0], axis=1)
    in_front = np.abs(distances - ranges) < 0.6  # not hidden by something nearer
    assert in_front.sum() > 10
    close = np.linalg.norm(hits[in_front] - voxels[inside][in_front], axis=1) <= 4
    assert close.mean() > 0.95


def test_left_is_left_and_up_is_up(frame):
    """Points at positive y are in the left half of the image, high ones in the upper half."""
    camera = frame.camera
    points = np.array([[20.0, 8.0, 0.0], [20.0, -8.0, 0.0], [20.0, 0.0, 3.0], [20.0, 0.0, -1.5]])
    camera_points = transform_points(points, camera.lidar_to_camera)
    pixels, _ = project_points(camera_points, camera.projection)
    assert pixels[0, 0] < SIZE[1] / 2 < pixels[1, 0]
    assert pixels[2, 1] < SIZE[0] / 2 < pixels[3, 1]


def test_written_files_read_back(root):
    frames = find_frames(root, streets(3).train_sequences, stride=5)
    assert [f.id for f in frames] == ["00/000000", "01/000000", "02/000000"]
    expected = make_frame(5, 0, 1, camera=CAMERA)
    labels = read_labels(frames[1])
    np.testing.assert_array_equal(labels == IGNORE, expected.scan.invalid)
    np.testing.assert_array_equal(
        labels[~expected.scan.invalid], expected.scan.labels[~expected.scan.invalid]
    )
    np.testing.assert_array_equal(read_image(frames[1].image), expected.image)
    np.testing.assert_array_equal(read_mask(frames[1].voxel_file("bin")), expected.scan.hits)
    camera = read_camera(frames[1].calibration, SIZE)
    np.testing.assert_array_equal(camera.projection, expected.camera.projection)
    assert len(find_frames(root, ["08"], stride=5)) == 1
    assert (root / "sequences/00/poses.txt").read_text().count("\n") == 5


def test_only_missing_worlds_are_written(root, capsys):
    before = contents(root)
    assert write_streets(root, streets(3, 1), progress=False) == 0
    (root / "sequences/02/voxels/000000.invalid").unlink()
    assert write_streets(root, streets(3, 1)) == 1
    assert f"{root}: 1 of 4 synthetic worlds are missing" in capsys.readouterr().out
    assert contents(root) == before


def test_files_do_not_depend_on_the_number_of_processes(root, tmp_path):
    write_streets(tmp_path, streets(3, 1), num_workers=2, progress=False)
    assert contents(tmp_path) == contents(root)


def test_a_complete_set_is_left_alone(tmp_path):
    """Label caches tell by a file's time of change whether it is the same."""
    settings = StreetSettings(1, 1, street_image_size=SIZE)
    assert write_streets(tmp_path, settings, progress=False) == 2
    files = [path for path in (tmp_path / "sequences").rglob("*") if path.is_file()]
    before = [path.stat().st_mtime_ns for path in files]
    assert write_streets(tmp_path, settings, progress=False) == 0
    assert [path.stat().st_mtime_ns for path in files] == before


def test_a_set_can_grow(root, tmp_path):
    write_streets(tmp_path, streets(1), progress=False)
    assert write_streets(tmp_path, streets(3, 1), progress=False) == 3
    assert contents(tmp_path) == contents(root)


@pytest.fixture(scope="module", params=[False, True], ids=["level", "tilted"])
def drive(tmp_path_factory, request):
    folder = tmp_path_factory.mktemp("drive")
    settings = streets(2, 2, scans_per_world=7, sensor_tilt=request.param)
    assert write_streets(folder, settings, progress=False) == 2
    return folder


def test_a_drive_has_images_at_10_hertz_and_voxels_for_every_fifth(drive):
    sequence = drive / "sequences/00"
    images = sorted(path.name for path in (sequence / "image_2").iterdir())
    assert images == [f"{number:06d}.png" for number in range(7)]
    assert sorted(path.name for path in (sequence / "voxels").glob("*.label")) == [
        "000000.label",
        "000005.label",
    ]
    assert len(find_frames(drive, ["00"], stride=5)) == 2
    times = np.loadtxt(sequence / "times.txt")
    np.testing.assert_allclose(np.diff(times), 0.1)
    assert len(times) == len(np.loadtxt(sequence / "poses.txt")) == 10


def test_poses_align_frames(drive):
    """Static voxels transformed with ``poses.txt`` coincide with those of the other frame."""
    frames = find_frames(drive, ["00"], stride=5)
    rows = np.loadtxt(drive / "sequences/00/poses.txt").reshape(-1, 3, 4)
    to_camera = read_camera(frames[0].calibration, SIZE).lidar_to_camera
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


def test_worlds_of_a_sequence_are_far_apart_in_its_poses(tmp_path):
    write_streets(tmp_path, streets(11), progress=False)
    poses = np.loadtxt(tmp_path / "sequences/00/poses.txt")
    assert len(poses) == 10  # two worlds of one scan each
    steps = np.linalg.norm(np.diff(poses[:, [3, 7, 11]], axis=0), axis=1)
    assert steps[4] > 900
    assert np.delete(steps, 4).max() < 1.5


def test_another_camera_sees_the_same_world():
    wide = make_frame(0, 0, 7, camera=kitti_camera((128, 256), horizontal_fov=120.0))
    assert wide.image.shape == (128, 256, 3)
    focal = wide.camera.projection[0, 0]
    assert 2 * np.degrees(np.arctan(128 / focal)) == pytest.approx(120)
    narrow = make_frame(0, 0, 7, camera=CAMERA)
    np.testing.assert_array_equal(wide.scan.labels, narrow.scan.labels)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 6}, "seed=5, not 6"),
        ({"street_image_size": (32, 100)}, "image_size"),
        ({"street_image_size": (16, 100)}, "32 pixels or more"),
        ({"horizontal_fov": 90.0}, "horizontal_fov=None, not 90"),
        ({"horizontal_fov": 170.0}, "give 10 to 150"),
        ({"scans_per_world": 3}, "scans_per_world=1, not 3"),
        ({"scans_per_world": 6}, "multiple of 2"),
        ({"scans_per_world": 99}, "give 1 to 40"),
        ({"num_train": 2}, "more than 2"),
        ({"num_val": -1}, "num_val=-1"),
    ],
)
def test_invalid_and_different_settings_are_reported(root, change, message):
    with pytest.raises(InputError, match=message) as error:
        write_streets(root, streets(**({"num_train": 3, "num_val": 1} | change)), progress=False)
    assert "\n" not in str(error.value)


def test_folders_with_other_data_are_reported(tmp_path):
    (tmp_path / "real/sequences").mkdir(parents=True)
    with pytest.raises(InputError, match="not synthetic streets"):
        write_streets(tmp_path / "real", streets(1))
    (tmp_path / "streets.json").write_text("[1")
    with pytest.raises(InputError, match=r"streets\.json"):
        write_streets(tmp_path, streets(1))


def test_settings_are_written_to_the_folder(root):
    noted = json.loads((root / "streets.json").read_text())
    assert noted["generator_version"] == GENERATOR_VERSION
    assert (noted["num_train"], noted["num_val"]) == (3, 1)


@pytest.mark.parametrize("text", ["", "no JSON", "[]", '["num_train"]', "many", "null"])
def test_damaged_settings_are_reported(tmp_path, text):
    path = tmp_path / "streets.json"
    path.write_text(text)
    if text in ("many", "null"):
        fitting = {
            **{"generator_version": GENERATOR_VERSION, "seed": 5, "image_size": SIZE},
            **{"horizontal_fov": None, "scans_per_world": 1},
        }
        path.write_text(json.dumps({**fitting, "num_train": None if text == "null" else text}))
    with pytest.raises(InputError) as caught:
        write_streets(tmp_path, streets(1))
    assert one_line_error(caught, path)


def test_cameras_stand_and_look_as_they_are_told(tmp_path):
    """Each training sequence at a height of its own; the voxels stay where they are."""
    plain, other = tmp_path / "plain", tmp_path / "other"
    write_streets(plain, streets(3, 1), progress=False)
    mounted = streets(3, 1, camera_height=2.0, camera_pitch=-6.0, training_heights=(1.2, 3.0))
    write_streets(other, mounted, progress=False)
    for sequence, height in (("00", 1.2), ("01", 1.4), ("02", 1.6), ("08", 2.0)):
        camera = read_camera(other / f"sequences/{sequence}/calib.txt", SIZE)
        before = read_camera(plain / f"sequences/{sequence}/calib.txt", SIZE)
        moved = np.linalg.inv(camera.lidar_to_camera)[:3, 3]
        still = np.linalg.inv(before.lidar_to_camera)[:3, 3]
        np.testing.assert_allclose(moved - still, [0, 0, height - 1.65], atol=1e-6)
        ahead = [np.degrees(np.arcsin(each.lidar_to_camera[2, 2])) for each in (camera, before)]
        assert ahead[0] - ahead[1] == pytest.approx(-6, abs=1e-3)
        for kind in ("label", "invalid", "bin"):
            name = f"sequences/{sequence}/voxels/000000.{kind}"
            assert (other / name).read_bytes() == (plain / name).read_bytes()
        name = f"sequences/{sequence}/image_2/000000.png"
        assert (other / name).read_bytes() != (plain / name).read_bytes()
    with pytest.raises(InputError, match="has streets with mounting="):
        write_streets(other, streets(3, 1), progress=False)
    with pytest.raises(InputError, match=r"give \[lowest, highest\] in metres"):
        streets(1, 1, training_heights=(2.0, 1.0))


def test_streets_with_another_tilt_are_refused(tmp_path):
    """A folder records the angles that its tilts were drawn with; ``true`` was a former version."""
    tilted = streets(1, 1, sensor_tilt=True)
    write_streets(tmp_path, tilted, progress=False)
    write_streets(tmp_path, tilted, progress=False)
    path = tmp_path / "streets.json"
    record = json.loads(path.read_text())
    for other in (True, record["mounting"]["tilt"] | {"down": 0.6}):
        record["mounting"]["tilt"] = other
        path.write_text(json.dumps(record))
        with pytest.raises(InputError, match="has streets with mounting="):
            write_streets(tmp_path, tilted, progress=False)
