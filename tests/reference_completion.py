"""A second implementation of SemanticKITTI's completion evaluation, as a reference for tests.

It follows ``evaluate_completion.py`` and ``iouEval`` of the SemanticKITTI development kit, imports
nothing from ``occdetr``, unpacks the bits by hand, and counts with ``np.add.at``.
"""

import os

import numpy as np

LEARNING_MAP = """
0:0 1:0 10:1 11:2 13:5 15:3 16:5 18:4 20:5 30:6 31:7 32:8 40:9 44:10 48:11 49:12 50:13 51:14 52:0
60:9 70:15 71:16 72:17 80:18 81:19 99:0 252:1 253:7 254:6 255:8 256:5 257:5 258:4 259:5
"""


def lookup_table():
    table = np.zeros(360, dtype=np.int32)
    for pair in LEARNING_MAP.split():
        raw, label = pair.split(":")
        table[int(raw)] = int(label)
    table[table == 0] = 255
    table[0] = 0
    return table


def unpack_bits(packed):
    bits = np.zeros(len(packed) * 8, dtype=np.uint8)
    for position in range(8):
        bits[position::8] = packed >> (7 - position) & 1
    return bits


def count_pairs(confusion, prediction, target, invalid):
    """Add the voxels of one frame to ``confusion``: rows prediction, columns truth."""
    keep = np.ones(target.shape, dtype=bool)
    keep[target == 255] = False
    keep[invalid == 1] = False
    np.add.at(confusion, (prediction[keep].astype(np.int64), target[keep].astype(np.int64)), 1)


def scores(confusion):
    true_positive = np.diag(confusion)
    false_positive = confusion.sum(axis=1) - true_positive
    false_negative = confusion.sum(axis=0) - true_positive
    jaccard = true_positive / (true_positive + false_positive + false_negative + 1e-15)
    epsilon = np.finfo(np.float32).eps
    occupied = np.sum(confusion[1:, 1:])
    return {
        "mIoU": float(jaccard[1:].mean()),
        "IoU": float(occupied / (np.sum(confusion) - confusion[0, 0])),
        "precision": float(occupied / (np.sum(confusion[1:, :]) + epsilon)),
        "recall": float(occupied / (np.sum(confusion[:, 1:]) + epsilon)),
        "classes": [float(value) for value in jaccard[1:]],
    }


def evaluate_folders(dataset, predictions, sequences):
    """Scores of ``predictions/sequences/NN/predictions/*.label`` against ``dataset``.

    Every ``.label`` of the sequences in ``dataset`` needs a prediction.
    """
    table = lookup_table()
    confusion = np.zeros((20, 20), dtype=np.int64)
    for sequence in sequences:
        truth_folder = os.path.join(dataset, "sequences", sequence, "voxels")
        prediction_folder = os.path.join(predictions, "sequences", sequence, "predictions")
        for name in sorted(os.listdir(truth_folder)):
            if not name.endswith(".label"):
                continue
            target = table[np.fromfile(os.path.join(truth_folder, name), dtype=np.uint16)]
            invalid_file = os.path.join(truth_folder, name.replace(".label", ".invalid"))
            invalid = unpack_bits(np.fromfile(invalid_file, dtype=np.uint8))
            predicted = np.fromfile(os.path.join(prediction_folder, name), dtype=np.uint16)
            count_pairs(confusion, table[predicted], target, invalid)
    return scores(confusion)
