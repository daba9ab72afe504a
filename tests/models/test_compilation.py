"""Compiled networks give the same results, in few graphs, and their checkpoints fit others."""

from __future__ import annotations

import tempfile
from pathlib import Path

from programs import alone


def test_compiled_network() -> None:
    alone(__file__)


def main() -> None:
    import torch
    from torch._dynamo.testing import CompileCounter

    from model_factory import fit_batches, small_batch, tiny_stage
    from occdetr.models.compilation import compile_network

    cpu, batch = torch.device("cpu"), small_batch(1)
    plain, compiled, graphs = tiny_stage("full"), tiny_stage("full"), CompileCounter()
    names = list(plain.state_dict())
    compile_network(compiled.model, cpu, graphs)
    assert list(compiled.state_dict()) == names

    before = graphs.frame_count
    (output, grid), (expected, expected_grid) = (
        module.eval().model.predict(batch) for module in (compiled, plain)
    )
    assert graphs.frame_count - before == 2  # the network and its fusion
    assert torch.equal(grid, expected_grid)
    assert torch.equal(output.detections.final.pred_boxes, expected.detections.final.pred_boxes)

    before = graphs.frame_count
    with tempfile.TemporaryDirectory() as folder:
        of_ranks = {"strategy": "ddp", "devices": 1}
        for module, given in ((plain, {}), (compiled, of_ranks)):
            trainer = fit_batches(module.train(), [batch], Path(folder), **given)
            trainer.save_checkpoint(Path(folder, f"{module is compiled}.ckpt"))
        assert graphs.frame_count - before >= 5  # one of each part, which ranks may divide
        own, others = (
            torch.load(Path(folder, f"{name}.ckpt"), weights_only=True) for name in (True, False)
        )
        assert list(own["state_dict"]) == names
        for name in names:
            torch.testing.assert_close(own["state_dict"][name], others["state_dict"][name])
        start = Path(folder, "True.ckpt")
        trainer = fit_batches(plain, [batch], Path(folder), start, max_epochs=2)
        assert trainer.global_step == 2


if __name__ == "__main__":
    main()
