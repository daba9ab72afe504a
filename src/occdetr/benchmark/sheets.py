"""What ``benchmark`` prints of its reports."""

from __future__ import annotations

from typing import Any

from occdetr.benchmark.sheet import Sheet

PARTS_NOTE = (
    "Least bytes: inputs, parameters and outputs, each moved once. Operator bytes: inputs and "
    "outputs of every operator. Share of the limit: the time that the device's measured rates "
    "allow for the multiply-adds or the least bytes, whichever is longer, / the time."
)
CURVES_NOTE = (
    "Exponents of growth: of all values, and of the last two. Memory is that of tensors beyond the "
    "parameters. objects: the time of fusion alone."
)


def parts_sheet(report: dict[str, Any]) -> Sheet:
    """Each part of the network, the rest and the whole."""
    columns = ["", "M params", "G macs", "least MiB", "operator MiB", "ms (quartiles)", "limit %"]
    sheet = Sheet(_title(report), columns)
    for name, part in report["parts"].items():
        params = _number(part.get("params"), 1e6, 2)
        sheet.rows.append([name.replace("_", " "), params, *_cost(part)])
    scene = report["scene"]
    sheet.notes = [
        f"Peak memory of the process: {report['peak_memory_mb']:.0f} MiB; of tensors beyond the "
        f"parameters: {report['tensor_memory_mb']:.0f} MiB. Street: {scene['occupied_voxels']:,} "
        f"occupied voxels, {scene['objects']} objects. {_limits(report)}",
        PARTS_NOTE,
    ]
    return sheet


def steps_sheet(report: dict[str, Any]) -> Sheet:
    """Each phase of a training step, and the forward pass by parts."""
    sheet = Sheet(
        f"Training step, stage={report['stage']}: {_title(report)}",
        ["", "G macs", "least MiB", "operator MiB", "ms (quartiles)", "limit %"],
    )
    for name, phase in report["phases"].items():
        part = name in report["parts"]
        sheet.rows.append([f"{'forward: ' if part else ''}{name}".replace("_", " "), *_cost(phase)])
    loader = report["loader"]
    sheet.notes = [
        f"Loader: {loader['cpu_ms_per_sample']:.1f} ms of a core for a sample, "
        f"{100 * loader['hidden']:.0f} % of it hidden behind the steps "
        f"({loader['workers']} worker). Peak memory: {report['peak_memory_mb']:.0f} MiB. "
        f"{_limits(report)}",
        PARTS_NOTE,
    ]
    return sheet


def peer_sheet(report: dict[str, Any]) -> Sheet:
    """Our network and its detector beside the peer."""
    columns = ["", "M params", "G macs", "ms (quartiles)", "times the peer's", "peak MiB"]
    sheet = Sheet(_title(report), [*columns, "tensors MiB"])
    for name, row in report["networks"].items():
        low, high = row["latency_ms_quartiles"]
        sheet.rows.append(
            [
                name,
                _number(row["params"], 1e6, 2),
                _number(row["macs"], 1e9, 1),
                f"{row['latency_ms']:.1f} ({low:.1f}-{high:.1f})",
                f"{row['times_the_peer']:.3f}",
                _number(row.get("peak_memory_mb"), 1, 0),
                _number(row.get("tensor_memory_mb"), 1, 0),
            ]
        )
    sheet.notes = [
        "Peer: Deformable DETR of Hugging Face's transformers "
        f"{report['transformers']} (two stages, box refinement, ResNet-50, random weights). The "
        "networks run in turn; the ratio is the median over the rounds. Peak: of a process of its "
        f"own, {report['imports_mb']:.0f} MiB of it before the peer is built."
    ]
    return sheet


def curves_sheet(report: dict[str, Any]) -> Sheet:
    """The exponents of every curve."""
    names = ["latency", "multiply-adds", "memory"]
    sheet = Sheet(_title(report), ["", "work", *names, "no worse than linear"])
    for name, curve in report["curves"].items():
        pairs = [f"{fit['exponent']:.2f}, {fit['last']:.2f}" for fit in curve["fits"].values()]
        linear = [cost for cost, fit in curve["fits"].items() if not fit["no_worse_than_linear"]]
        work = f"{curve['work'][0]:,} to {curve['work'][-1]:,} {curve['unit']}"
        sheet.rows.append([name, work, *pairs, f"no: {', '.join(linear)}" if linear else "yes"])
    sheet.notes = [CURVES_NOTE]
    return sheet


def loader_sheet(report: dict[str, Any]) -> Sheet:
    """Samples per second of the training frames."""
    height, width = report["image_size"]
    size = f"{height} x {width}, batch {report['batch_size']}, workers {report['workers']}"
    columns = ["samples per second and worker", "median (quartiles)"]
    sheet = Sheet(f"{report['frames']} frames, {size}", columns)
    for name, row in (("plain", "without augmentation"), ("augmented", "with augmentation")):
        median = report[name]["samples_per_second_per_worker"]
        low, high = report[name]["quartiles"]
        sheet.rows.append([row, f"{median:.1f} ({low:.1f}-{high:.1f})"])
    return sheet


def _title(report: dict[str, Any]) -> str:
    height, width = report["image_size"]
    threads = f", threads {report['threads']}" if report.get("threads") else ""
    return (
        f"{report['model']}, {height} x {width}, batch {report['batch_size']}, "
        f"{report['device']}, {report['precision']}{threads}"
    )


def _cost(part: dict[str, Any]) -> list[str]:
    low, high = part["latency_ms_quartiles"]
    share = part.get("share_of_limit")
    return [
        _number(part.get("macs"), 1e9, 2),
        _number(part.get("least_bytes"), 2**20, 1),
        _number(part.get("operator_bytes"), 2**20, 0),
        f"{part['latency_ms']:.1f} ({low:.1f}-{high:.1f})",
        "-" if share is None else f"{100 * share:.0f}",
    ]


def _number(value: float | None, unit: float, digits: int) -> str:
    return "-" if value is None else f"{value / unit:.{digits}f}"


def _limits(report: dict[str, Any]) -> str:
    flops, bandwidth = report["limits"]["flops"], report["limits"]["bandwidth"]
    return (
        f"Limits: {flops / 1e9:,.0f} GFLOP/s (one large product), {bandwidth / 1e9:.1f} GB/s (one "
        "large copy, read and written)."
    )
