"""From the image to the grid in one graph, without a break."""

from __future__ import annotations

from programs import alone


def test_prediction_is_one_graph() -> None:
    alone(__file__)


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
