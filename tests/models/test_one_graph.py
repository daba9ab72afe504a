"""From the image to the grid in one graph, without a break.

It runs in a process of its own: the compiler cannot follow the checks of shapes that the tests put
around functions.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def test_prediction_is_one_graph() -> None:
    path = os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, __file__],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]


def main() -> None:
    import torch

    from model_factory import small_batch, tiny_model

    model, batch = tiny_model().eval(), small_batch(1)

    def predict(images, camera):
        output = model(images, camera)
        return output.detections.final.pred_boxes, model.fusion(output.occupancy)

    with torch.no_grad():
        expected = predict(batch.images, batch.camera)
        compiled = torch.compile(predict, backend="eager", fullgraph=True)
        found = compiled(batch.images, batch.camera)
    assert torch.equal(found[0], expected[0])
    assert torch.equal(found[1], expected[1])


if __name__ == "__main__":
    main()
