"""The confusion matrix as an image."""

import numpy as np

from occdetr.drawing.confusion import CELL, draw_confusion


def cells(picture: np.ndarray) -> np.ndarray:
    """The colour of each cell's corner, where nothing is written; [20, 20, 3]."""
    top = picture.shape[0] - 20 * CELL
    left = top - 30  # the title's height
    grid = picture[top:, left : left + 20 * CELL]
    return grid[3::CELL, 3::CELL].astype(int)


def test_only_the_diagonal_of_a_perfect_prediction_is_bright() -> None:
    picture = draw_confusion(np.diag(np.arange(1, 21) * 10**5))
    brightness = cells(picture).sum(axis=2)
    assert brightness.shape == (20, 20)
    on, off = np.diag(brightness), brightness[~np.eye(20, dtype=bool)]
    assert on.min() > 2 * off.max()
    assert np.unique(off).size == 1


def test_rows_are_shares_of_the_true_class() -> None:
    confusion = np.diag(np.full(20, 1000))
    confusion[9, 1] = 3000  # cars predicted to be road
    confusion[:, 4] = 0  # no truck in the truth
    confusion[4, 6] = 1000  # persons predicted to be trucks
    colors = cells(draw_confusion(confusion))
    brightness = colors.sum(axis=2)
    assert brightness[1, 9] > brightness[1, 1] > brightness[9, 1]  # 75 %, 25 %, none
    assert (colors[6, 4] == colors[6, 6]).all()
    assert (colors[4] == 255).all()
    doubled = cells(draw_confusion(2 * confusion))
    np.testing.assert_array_equal(doubled, colors)
