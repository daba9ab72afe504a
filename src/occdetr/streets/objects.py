"""Shapes of what moves or stands on a street: one function of the random generator for each kind.

Every instance has its own dimensions and colours. An object stands on z = 0, faces x, and has its
footprint's centre at the origin; a sign or traffic light looks backwards (-x), at those who come.
"""

from occdetr.streets.cars import car
from occdetr.streets.cycles import bicycle, bicyclist, motorcycle, motorcyclist
from occdetr.streets.furniture import bollard, lamp, traffic_light
from occdetr.streets.people import person
from occdetr.streets.signs import traffic_sign
from occdetr.streets.trucks import truck
from occdetr.streets.vehicles import other_vehicle

__all__ = [
    "bicycle",
    "bicyclist",
    "bollard",
    "car",
    "lamp",
    "motorcycle",
    "motorcyclist",
    "other_vehicle",
    "person",
    "traffic_light",
    "traffic_sign",
    "truck",
]
