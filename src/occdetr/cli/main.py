"""The command ``occdetr``: ``occdetr train ...`` is ``python -m occdetr.train ...``."""

from __future__ import annotations

import difflib
import runpy
import sys

import occdetr

#: The module of each command, and what it does.
COMMANDS = {
    "train": ("occdetr.train", "train a stage of the network"),
    "evaluate": ("occdetr.evaluate", "measure a checkpoint, or the upper bound of a design"),
    "score": ("occdetr.score", "score voxels that any method has predicted"),
    "predict": ("occdetr.predict", "voxels and objects of images without labels"),
    "export": ("occdetr.export", "a network as a file: ONNX, torch.export or AOTInductor"),
    "prepare": ("occdetr.prepare", "write synthetic streets if need be, and cache object labels"),
    "visualize": ("occdetr.visualize", "pictures of the object labels"),
    "benchmark": ("occdetr.benchmark", "size and speed of a model, or of its data loaders"),
    "survey": ("occdetr.survey", "statistics of synthetic streets beside SemanticKITTI's"),
    "demo": ("occdetr.demo", "everything in one command, from streets to a picture"),
    "summarize": ("occdetr.summarize", "the runs of a sweep as a table, the best first"),
    "study": ("occdetr.study", "train and evaluate every arm of a study"),
    "results": ("occdetr.study.results", "tables and curves of the studies from their files"),
}


def main() -> None:
    """Run the module of a command as ``python -m`` does, with the remaining arguments.

    Lightning starts further ranks by the module's name, which ``runpy`` leaves as it is then.
    """
    sys.path.insert(0, "")  # as python -m does: classes of the user's own lie there
    command = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if command in ("-h", "--help"):
        print(usage())
    elif command in ("-V", "--version"):
        print(occdetr.__version__)
    elif command in COMMANDS:
        del sys.argv[1]
        runpy.run_module(COMMANDS[command][0], run_name="__main__", alter_sys=True)
    else:
        near = difflib.get_close_matches(command, COMMANDS, n=1)
        advice = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(COMMANDS)}"
        print(f"error: {command}: no such command: {advice}", file=sys.stderr)
        sys.exit(2)


def usage() -> str:
    """The commands, one a line."""
    lines = [f"  {name:<10} {purpose}" for name, (_, purpose) in COMMANDS.items()]
    return "\n".join(
        [
            "usage: occdetr <command> [setting=value ...]",
            "",
            *lines,
            "",
            "occdetr <command> --help shows the settings of a command and their values.",
        ]
    )


if __name__ == "__main__":
    main()
