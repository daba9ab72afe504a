"""Build and cache all object labels: ``python -m occdetr.prepare data=... data.root=...``."""

from __future__ import annotations

import os

from omegaconf import DictConfig

from occdetr import cli

SPLITS = ("train", "val")


@cli.entry_point("prepare")
def main(config: DictConfig) -> None:
    """Write synthetic streets if they are asked for, label all frames, write ``prepare.json``."""
    datamodule = cli.build(config.data)
    datamodule.prepare_data()
    for split in SPLITS:
        print(datamodule.summary(split), flush=True)
    workers = config.workers or os.cpu_count() or 1
    done = datamodule.prepare_objects(SPLITS, num_workers=workers)
    frames = done.built + done.reused
    rate = frames / max(done.seconds, 1e-9)
    report = {
        "root": str(datamodule.root),
        "cache": str(datamodule.cache_dir),
        "partition": config.partition_name,
        "frames": frames,
        "built": done.built,
        "reused": done.reused,
        "objects": done.objects,
        "seconds": round(done.seconds, 3),
        "frames_per_second": round(rate, 2),
        "workers": workers,
    }
    folder = cli.run_folder()
    cli.write_json(folder / "prepare.json", report)
    print(
        f"done: {frames} frames ({done.built} built, {done.reused} already there), {done.objects} "
        f"objects, {rate:.1f} frames/s; next: python -m occdetr.train stage=pretrain "
        f"data.root={datamodule.root}"
    )


if __name__ == "__main__":
    main()
