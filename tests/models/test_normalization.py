"""Images as bytes and normalised."""

import torch

from model_factory import IMAGE_SIZE, camera, tiny_model
from occdetr.models.normalization import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    denormalize_images,
    normalize_images,
)


def test_bytes_are_normalised_with_imagenets_statistics():
    images = torch.zeros(2, 3, 4, 5, dtype=torch.uint8)
    images[1, 0], images[1, 2] = 255, 51  # red, blue
    mean, std = torch.tensor(IMAGENET_MEAN), torch.tensor(IMAGENET_STD)
    expected = (torch.tensor([1.0, 0.0, 0.2]) - mean) / std
    assert torch.allclose(normalize_images(images)[1, :, 3, 4], expected, atol=1e-6)


def test_denormalisation_inverts_normalisation():
    """For every value of every channel; bytes stay as they are."""
    values = torch.arange(256, dtype=torch.uint8).reshape(1, 1, 16, 16)
    images = torch.cat([values, values.flip(2), values.flip(3)], dim=1)
    assert torch.equal(denormalize_images(normalize_images(images)), images)
    assert torch.equal(denormalize_images(images), images)


def test_the_network_sees_the_same_in_bytes_and_normalised():
    model = tiny_model().eval()
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(256, (1, 3, *IMAGE_SIZE), dtype=torch.uint8, generator=generator)
    with torch.no_grad():
        in_bytes = model(images, camera(1)).detections
        normalised = model(normalize_images(images), camera(1)).detections
    assert torch.equal(in_bytes.final.pred_logits, normalised.final.pred_logits)
    assert in_bytes.final.pred_logits.std() > 0
