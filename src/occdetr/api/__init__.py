"""The Python interface: ``load`` a model, describe a ``Camera``, get a ``Result``."""

from occdetr.api.camera import Camera, Mount
from occdetr.api.model import Model, Result, load
from occdetr.api.viewer import Recording

__all__ = ["Camera", "Model", "Mount", "Recording", "Result", "load"]
