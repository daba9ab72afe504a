"""The image on which an exported network is compared with the network itself."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from omegaconf import DictConfig

from occdetr.cli import entry as cli
from occdetr.data.dataset import PictureDataset, collate
from occdetr.export.formats import Inputs
from occdetr.models.occdetr import OccupancyDETR


def street_inputs(config: DictConfig, model: OccupancyDETR, device: torch.device) -> Inputs:
    """The inputs of ``ImageToGrid``: a synthetic street at the model's image size, its camera."""
    with TemporaryDirectory() as folder:
        size = list(model.image_size)
        cli.build(config.scene, root=folder, street_image_size=size).prepare_data()
        sequence = Path(folder, "sequences/00")
        images = [sequence / "image_2/000000.png"]
        (item,) = PictureDataset(images, sequence / "calib.txt", model.image_size)
        batch = collate([item]).to(device)
    return batch.images, batch.camera.projection, batch.camera.lidar_to_camera
