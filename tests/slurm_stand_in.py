"""The commands of SLURM, as far as submitit and our scripts need them, for one machine.

``sbatch`` starts a job's script (of an array all of them) at once, in the background; ``srun`` its
tasks, which all lie on this machine, whatever the number of nodes; after ``scontrol requeue`` a job
that has ended starts again. ``install`` makes a folder of them, to be put into ``PATH``.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

COMMANDS = ("sbatch", "srun", "scontrol", "sacct")
#: Options of ``srun`` whose value is the next word.
VALUES = ("--output", "--error")


def install(folder: Path) -> Path:
    """Write the commands; the state of the jobs is beside them."""
    folder.mkdir()
    for name in COMMANDS:
        line = f'exec {shlex.quote(sys.executable)} {shlex.quote(__file__)} {name} "$@"'
        (folder / name).write_text(f"#!/bin/sh\nSTAND_IN={shlex.quote(str(folder))} {line}\n")
        (folder / name).chmod(0o755)
    return folder


def state(job: str, suffix: str) -> Path:
    return Path(os.environ["STAND_IN"], f"{job}.{suffix}")


def sbatch(script: str) -> int:
    text = Path(script).read_text()
    lines = "\n".join(re.findall(r"^#SBATCH.*", text, re.MULTILINE))
    flags = dict(re.findall(r"--([\w-]+)(?:=(\S+))?", lines))
    number = 100 * (1 + len(list(Path(os.environ["STAND_IN"]).glob("*.submitted"))))
    state(str(number), "submitted").touch()
    nodes, each = int(flags.get("nodes", 1)), int(flags.get("ntasks-per-node", 1))
    variables = {
        **{"JOB_NAME": flags.get("job-name", "job"), "NTASKS": str(nodes * each)},
        **{"NTASKS_PER_NODE": str(each), "NNODES": str(nodes), "JOB_NUM_NODES": str(nodes)},
        **{"NODELIST": "127.0.0.1", "JOB_NODELIST": "127.0.0.1"},
        "CPUS_PER_TASK": flags.get("cpus-per-task", "1"),
    }
    if "array" in flags:
        first, last = map(int, flags["array"].split("%")[0].split("-"))
        variables |= {"ARRAY_JOB_ID": str(number), "ARRAY_TASK_COUNT": str(last - first + 1)}
        for task in range(first, last + 1):
            own = {"JOB_ID": str(number + task), "ARRAY_TASK_ID": str(task)}
            start(f"{number}_{task}", text, variables | own, flags.get("output"))
    else:
        start(str(number), text, variables | {"JOB_ID": str(number)}, flags.get("output"))
    print(f"Submitted batch job {number}")
    return 0


def start(job: str, script: str, variables: dict[str, str], output: str | None) -> None:
    state(job, "sh").write_text(script)
    environment = {**os.environ, **{f"SLURM_{name}": value for name, value in variables.items()}}
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    words = [sys.executable, __file__, "run", job, output or "slurm-%j.out"]
    subprocess.Popen(words, env=environment, start_new_session=True, **streams)


def run(job: str, output: str) -> int:
    """A job from its start to its end, again as long as it is requeued."""
    file = Path(expanded(output, "0"))
    file.parent.mkdir(parents=True, exist_ok=True)
    code = 1
    for restarts in range(5):
        environment = {**os.environ, "SLURM_RESTART_COUNT": str(restarts)}
        with file.open("a") as log:
            words = ["bash", str(state(job, "sh"))]
            code = subprocess.run(words, stdout=log, stderr=log, env=environment).returncode
        if not state(job, "requeue").exists():
            break
        state(job, "requeue").unlink()
    state(job, "done").write_text(str(code))
    return code


def expanded(pattern: str, task: str) -> str:
    job = os.environ["SLURM_JOB_ID"]
    values = {
        "%A": os.environ.get("SLURM_ARRAY_JOB_ID", job),
        "%a": os.environ.get("SLURM_ARRAY_TASK_ID", "0"),
        **{"%j": job, "%t": task},
    }
    return re.sub("%[Aajt]", lambda match: values[match[0]], pattern)


def srun(*words: str) -> int:
    words, options = list(words), {}
    while words[0].startswith("--"):
        name, _, value = words.pop(0).partition("=")
        options[name] = words.pop(0) if name in VALUES else value
    each, total = (int(os.environ[f"SLURM_{name}"]) for name in ("NTASKS_PER_NODE", "NTASKS"))
    tasks = []
    with contextlib.ExitStack() as files:
        for rank in map(str, range(total)):
            own = {"SLURM_PROCID": rank, "SLURM_LOCALID": str(int(rank) % each)}
            own["SLURM_NODEID"] = str(int(rank) // each)
            streams = [
                files.enter_context(open(expanded(options[name], rank), "a"))
                if name in options
                else None
                for name in VALUES
            ]
            environment = {**os.environ, **own}
            opened = dict(zip(("stdout", "stderr"), streams, strict=True))
            tasks.append(subprocess.Popen(words, env=environment, **opened))
    signal.signal(signal.SIGTERM, lambda number, _: [task.send_signal(number) for task in tasks])
    return max(abs(task.wait()) for task in tasks)


def scontrol(verb: str, job: str) -> int:
    assert verb == "requeue", verb
    mark = state(job, "requeue")
    assert not mark.exists(), "requeued twice"
    mark.touch()
    return 0


def sacct(*_: str) -> int:
    print("JobID|State")
    for file in Path(os.environ["STAND_IN"]).glob("*.sh"):
        print(f"{file.stem}|{'COMPLETED' if state(file.stem, 'done').exists() else 'RUNNING'}")
    return 0


if __name__ == "__main__":
    sys.exit(globals()[sys.argv[1]](*sys.argv[2:]))
