"""The objects of a street: one function of the random generator for each kind.

Every instance has its own dimensions and colours. An object is on z = 0, faces +x, and has the
centre of its footprint at the origin. Signs and traffic lights face -x, towards oncoming traffic.
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
