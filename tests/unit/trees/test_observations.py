"""What a record keeps: the window, and one arrival before it."""

from understudy.trees.observations import TopicRecord


def record(window: float, *times: float) -> TopicRecord:
    made = TopicRecord(window)
    for time in times:
        made.add(time)
    return made


def test_arrivals_within_the_window_and_one_before_are_kept():
    made = record(2.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    assert list(made.arrivals) == [4.0, 5.0, 6.0]  # at 6.0 the one of 4.0 has just left the window
    assert (made.last, made.count) == (6.0, 6)


def test_without_a_window_only_the_last_arrival_is_kept():
    assert list(record(0.0, 1.0, 2.0, 3.0).arrivals) == [3.0]


def test_late_arrival_finds_its_place():
    made = record(5.0, 1.0, 3.0, 2.0)
    assert list(made.arrivals) == [1.0, 2.0, 3.0]
    assert made.last == 3.0


def test_shift_moves_every_time():
    made = record(5.0, 1.0, 3.0)
    made.shift(-1.0)
    assert (list(made.arrivals), made.last, made.count) == ([0.0, 2.0], 2.0, 2)


def test_shift_of_nothing_is_nothing():
    made = record(5.0)
    made.shift(3.0)
    assert made.last is None
