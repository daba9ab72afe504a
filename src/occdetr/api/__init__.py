"""The Python interface: ``load`` a model, describe a ``Camera``, get a ``Result``."""

from occdetr.api.camera import Camera, Mount
from occdetr.api.model import Model, Result, load

__all__ = ["Camera", "Model", "Mount", "Result", "load"]
