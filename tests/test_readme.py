"""The Python of the README runs on a checkpoint of the smallest model."""

from __future__ import annotations

import numpy as np

from documents import REPOSITORY, code_blocks, read
