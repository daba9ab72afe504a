"""Steps that run beside each other: order, overlap, bounds and errors."""

import threading

import pytest

from occdetr.data.ahead import map_ahead


@pytest.mark.parametrize("threads", [1, 3])
def test_results_are_in_order(threads):
    assert list(map_ahead(lambda x: x * x, range(50), threads)) == [x * x for x in range(50)]
    assert list(map_ahead(str, [], threads)) == []


def test_the_next_item_is_taken_while_a_call_runs():
    taken = threading.Event()

    def items():
        yield 0
        taken.set()
        yield 1

    assert list(map_ahead(lambda _: taken.wait(30), items())) == [True, True]


@pytest.mark.parametrize("threads", [1, 3])
def test_few_items_are_taken_ahead(threads):
    taken = []
    results = map_ahead(str, map(taken.append, range(100)), threads)
    next(results)
    assert len(taken) == threads + 2
    next(results)
    assert len(taken) == threads + 3


def test_an_error_takes_the_place_of_its_result():
    done = []

    def call(item):
        if item == 2:
            raise ValueError("item 2")
        done.append(item)
        return item

    results = map_ahead(call, range(100))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="item 2"):
        next(results)
    assert done == [0, 1, 3, 4]  # those that were taken are finished
    assert list(results) == []
