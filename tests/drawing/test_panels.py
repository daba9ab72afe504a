"""Panels of scenes and labels."""

import numpy as np
import pytest

from occdetr.classes import CLASS_COLORS, CLASS_NAMES
from occdetr.data.objects import ObjectSettings, extract_objects
from occdetr.drawing.boxes import class_legend
from occdetr.drawing.grids import UNCLAIMED, object_colors
from occdetr.drawing.panels import (
    COLUMN,
    comparison_panel,
    contact_sheet,
    label_panel,
    scene_column,
    scene_panel,
    sheet_row,
)
from occdetr.geometry.camera import resize_camera
from scene_factory import CAMERA, put_box, street
from voxel_scenes import car_and_vegetation


@pytest.fixture
def labels():
    return car_and_vegetation()


def test_scene_panel_has_image_grids_and_legend(labels):
    image = np.full((37, 122, 3), 90, dtype=np.uint8)
    boxes = np.array([[10.0, 5.0, 40.0, 30.0]])
    both = scene_panel(image, boxes, [1], [0.5], labels, labels, width=640, title="frame 08/000005")
    one = scene_panel(image, boxes, [1], prediction=labels, width=640)
    bare = scene_panel(image, width=640)
    assert both.shape[1] == one.shape[1] == bare.shape[1] == 640
    assert both.shape[0] > bare.shape[0]
    legend = class_legend(640)
    for color in CLASS_COLORS[1:]:
        assert (legend == color).all(axis=2).any()
        assert (both == color).all(axis=2).any()


def test_comparison_has_both_views_of_each_column(labels):
    image = np.full((37, 122, 3), 90, dtype=np.uint8)
    boxes = np.array([[10.0, 5.0, 40.0, 30.0]])
    truth = scene_column(image, boxes, [1], None, labels, "ground truth")
    empty = scene_column(image, boxes[:0], [], [], np.zeros_like(labels), "prediction")
    assert truth.shape == empty.shape
    assert truth.shape[1] == COLUMN
    bottom = 30 + round(37 * COLUMN / 122)  # of the title and the image
    car = CLASS_COLORS[1]
    assert (truth[30:bottom] == car).all(axis=2).any()
    assert not (empty[30:bottom] == car).all(axis=2).any()
    raised, bird = np.array_split(truth[bottom:], [COLUMN - round(0.41 * COLUMN)], axis=1)
    assert (raised < 250).any(axis=2).sum() > 500
    assert (bird < 250).any(axis=2).sum() > 500
    assert (empty[bottom:] == 255).all()
    panel = comparison_panel([truth, empty], "08/000000")
    assert panel.shape[1] == 2 * COLUMN + 12


@pytest.mark.parametrize("photograph", [True, False])
def test_label_panel_has_every_object_in_its_color(photograph):
    labels = street()
    put_box(labels, "car", (6.0, -20.0, 0.0), (4.0, 1.0, 1.6))  # outside the image
    settings = ObjectSettings()
    objects = extract_objects(labels, CAMERA, settings)
    camera = resize_camera(CAMERA, (192, 640))
    image = np.full((192, 640, 3), 90, dtype=np.uint8) if photograph else None
    panel = label_panel(image, camera, labels, objects, settings.classes, "00/000000")
    assert panel.shape[1] == 640
    assert len(objects) == 2
    for color in [*object_colors(2), UNCLAIMED]:
        assert (panel == color).all(axis=2).sum() > 100  # at least its patch in the legend
    assert (panel[30:222] == 90).all(axis=2).any() == photograph


def test_contact_sheet_has_all_rows_and_the_legend():
    labels = street()
    image = np.full((120, 400, 3), 90, dtype=np.uint8)
    row = sheet_row(image, CAMERA, labels, 600)
    assert row.shape == (round(228 * 120 / 400), 600, 3)
    assert (row[:, :228] == 90).all()
    road = CLASS_COLORS[CLASS_NAMES.index("road")] / 255
    seen = row[:, 232:460].reshape(-1, 3) / 255
    assert (np.abs(seen - road).max(axis=1) < 0.4).any()
    sheet = contact_sheet([row, row])
    assert sheet.shape == (2 * (row.shape[0] + 4) + class_legend(600).shape[0], 600, 3)
