"""What the record of a run must hold for the tables and curves of its study."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

from occdetr.errors import InputError
from occdetr.study.arm import DETECTION
from occdetr.study.tables import CURVES, SCORES
from occdetr.training.compare_settings import select

#: Facts of a record that every study shows, and their types.
FACTS = {
    **{"command": str, "study": str, "arm": str, "seed": int},
    **{"commit": str | None, "dirty": bool | None, "code": str, "code_changed": bool},
    **{"generator_version": int | None, "model": str},
    **{"machine.cpu": str, "machine.cores": int, "machine.device": str},
    **{"machine.torch": str, "machine.precision": str},
    **{"steps": int, "seconds": float, "curve": list, "stages": dict},
}


def read_record(path: Path, arm: str, seed: int, plan: Mapping[str, Any]) -> dict[str, Any]:
    """The record of an arm and a seed in the folder of its study; ``plan`` as of ``read_study``.

    Raises ``InputError`` if the file is none, is that of another run, or lacks something that the
    tables and curves of the study need.
    """
    study = path.parent.name
    if plan["splits"] and seed not in plan["seeds"]:
        last = plan["seeds"][-1]
        raise InputError(f"{path}: study {study} has splits 0 to {last}: move it away")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        record = {}
    record = record if isinstance(record, dict) else {}
    found = [select(record, key) for key in ("study", "arm", "seed")]
    if found != [study, arm, seed]:
        raise InputError(
            f"{path}: is not the record of study {study}, {arm}, seed {seed}: move it away and run "
            "that arm again"
        )
    fault = first_fault(record, needed(study, arm, plan)) or other_fault(record, study, arm, plan)
    if fault is not None:
        raise InputError(
            f"{path}: is not a valid record of occdetr.study: {fault} is missing or not as needed: "
            "run that arm again, with rebuild=true"
        )
    return record


def needed(study: str, arm: str, plan: Mapping[str, Any]) -> dict[str, Any]:
    """The facts that a record of an arm needs, by path, and their types."""
    settings = plan["arms"][arm]
    absent = DETECTION if settings.get("baseline") else ()  # which finds no objects
    numbers = [f"figures.{key}" for key in SCORES[study] if key not in absent]
    numbers += ["peak_memory_mb"] if settings["stages"] else []
    numbers += ["latency.latency_ms"] if plan["latency"] else []
    stages = {f"stages.{stage}.steps": int for stage in settings["stages"]}
    return {**FACTS, **dict.fromkeys(numbers, float), **stages}


def first_fault(facts: Any, kinds: Mapping[str, Any]) -> str | None:
    """The path of the first fact that is missing or of another type; None if all are there."""
    facts = facts if isinstance(facts, dict) else {}
    return next((path for path in kinds if not fits(select(facts, path), kinds[path])), None)


def fits(value: Any, kind: Any) -> bool:
    """Whether a value of JSON has a type; a float is any finite number, true is none."""
    if kind is float:
        return type(value) in (int, float) and abs(value) < 1e15
    return type(value) in (get_args(kind) or (kind,))


def other_fault(
    record: Mapping[str, Any], study: str, arm: str, plan: Mapping[str, Any]
) -> str | None:
    """What a record with all facts has wrong: its command, its stages or its curve."""
    stages = plan["arms"][arm]["stages"]
    try:
        shlex.split(record["command"])
    except ValueError:
        return "command"
    if list(record["stages"]) != stages:
        return f"stages ({', '.join(stages) or 'none'})"
    return fault_of_curve(record, CURVES[study]) if study in CURVES else None


def fault_of_curve(record: Mapping[str, Any], scores: Iterable[str]) -> str | None:
    """What the curve of a record lacks: the last stage is plotted, by the steps of that stage."""
    *earlier, last = record["stages"]
    before = sum(record["stages"][stage]["steps"] for stage in earlier)
    plotted = 0
    for number, point in enumerate(record["curve"]):
        wrong = first_fault(point, {"stage": str, "step": int})
        if wrong is None and point["stage"] == last:
            plotted += 1
            wrong = first_fault(point, dict.fromkeys(scores, float))
            if wrong is None and point["step"] <= before:
                wrong = "step"
        if wrong is not None:
            return f"curve[{number}].{wrong}"
    return None if plotted else f"a validation of stage={last} in curve"
