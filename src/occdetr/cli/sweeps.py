"""The jobs of a sweep (``-m``), checked before the first one runs."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode


def check_sweep(compose_checked: Callable[[list[str]], Any]) -> None:
    """Compose the configuration of every job, in the first one; later ones could be hours away.

    Sweepers other than Hydra's own choose their jobs as they go: theirs are not known. Raises
    ``InputError`` as ``compose_checked``.
    """
    settings: Any = HydraConfig.get()
    own = settings.sweeper.get("_target_", "").endswith(f".{BasicSweeper.__name__}")
    if settings.mode != RunMode.MULTIRUN or settings.job.num != 0 or not own:
        return
    words = [word for word in sys.argv[1:] if re.match(r"~|\+{0,2}[\w./@]+=", word)]
    loader = GlobalHydra.instance().config_loader()
    parsed = OverridesParser.create(config_loader=loader).parse_overrides(words)
    (jobs,) = BasicSweeper.split_arguments(parsed, None)
    for job in jobs[1:]:
        compose_checked(job)
