"""Random grids, objects and detections for the tests of the metrics."""

import numpy as np
import torch

from occdetr.structures import empty_target

SMALL = (12, 10, 8)


def random_grids(seed, frames=3, shape=SMALL, num_classes=20):
    """Mostly empty predictions and targets with some rare classes, and 255 in the target."""
    rng = np.random.default_rng(seed)
    shares = np.concatenate([[3.0], rng.random(num_classes - 1) ** 4])
    shares /= shares.sum()
    target = rng.choice(num_classes, (frames, *shape), p=shares).astype(np.uint8)
    guess = rng.choice(num_classes, target.shape, p=shares).astype(np.uint8)
    prediction = np.where(rng.random(target.shape) < 0.6, target, guess)
    target[rng.random(target.shape) < 0.25] = 255
    return prediction, target


def boxes_target(classes, boxes_cxcywh, boxes3d=None):
    target = empty_target()
    target.classes = torch.tensor(classes, dtype=torch.long)
    target.boxes_cxcywh = torch.tensor(boxes_cxcywh).view(-1, 4)
    target.boxes3d_camera = boxes3d if boxes3d is not None else torch.ones(len(classes), 6)
    x_y_z = [2, 0, 1]  # ahead, left and up are a camera's z, x and y, but for the signs
    target.boxes3d_grid = target.boxes3d_camera.unflatten(1, (2, 3))[:, :, x_y_z].flatten(1)
    return target


def as_xyxy(boxes):
    return torch.cat([boxes[..., :2] - boxes[..., 2:] / 2, boxes[..., :2] + boxes[..., 2:] / 2], -1)


def random_frame(seed):
    """A target of 0-4 objects and 12 detections, some of them near an object."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    count = seed % 5
    target = boxes_target(
        torch.randint(1, 4, (count,), generator=generator).tolist(),
        torch.cat([0.2 + 0.6 * uniform(count, 2), 0.1 + 0.2 * uniform(count, 2)], 1).tolist(),
        torch.cat([10 * uniform(count, 3), 1 + uniform(count, 3)], 1),
    )
    classes = torch.randint(1, 5, (12,), generator=generator)
    boxes = torch.cat([0.2 + 0.6 * uniform(12, 2), 0.1 + 0.2 * uniform(12, 2)], 1)
    boxes3d = torch.cat([10 * uniform(12, 3), 1 + uniform(12, 3)], 1)
    for i in range(2 * count):  # two near each object
        classes[i] = target.classes[i // 2]
        boxes[i] = target.boxes_cxcywh[i // 2] + 0.03 * (uniform(4) - 0.5)
        boxes3d[i] = target.boxes3d_camera[i // 2] + 0.5 * (uniform(6) - 0.5)
    return uniform(12), classes, as_xyxy(boxes), boxes3d, target


def update(metric, frames):
    """One batch of several frames, given by their seeds, which are their indices too."""
    parts = list(zip(*(random_frame(index) for index in frames), strict=True))
    scores_, classes, boxes, boxes3d = (torch.stack(part) for part in parts[:4])
    metric.update(torch.tensor(frames), scores_, classes, boxes, boxes3d, list(parts[4]))
