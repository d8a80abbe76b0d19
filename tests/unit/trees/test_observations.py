"""What a record keeps: the window, and one arrival before it; and the longest gap of late."""

from understudy.trees.core.observations import TopicRecord


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


def test_a_late_arrival_is_inserted_at_its_place():
    made = record(5.0, 1.0, 3.0, 2.0)
    assert list(made.arrivals) == [1.0, 2.0, 3.0]
    assert made.last == 3.0


def test_a_shift_moves_every_time():
    made = record(5.0, 1.0, 3.0)
    made.shift(-1.0)
    assert (list(made.arrivals), made.last, made.count) == ([0.0, 2.0], 2.0, 2)


def test_a_shift_of_an_empty_record_changes_nothing():
    made = record(5.0)
    made.shift(3.0)
    assert made.last is None


def test_the_longest_gap_is_known_for_at_least_a_minute():
    made = record(0.0, *(100.0 + n / 10 for n in range(10)), 103.0)
    assert made.longest_gap(103.1) == 103.0 - 100.9
    for n in range(600):
        made.add(103.1 + n / 10)
    assert made.longest_gap(163.0) == 103.0 - 100.9
    for n in range(1300):
        made.add(163.1 + n / 10)
    assert 0.09 < made.longest_gap(293.0) < 0.11, "that was long ago"


def test_silence_is_a_gap_while_it_lasts():
    made = record(0.0, 100.0, 100.5)
    assert [made.longest_gap(now) for now in (100.4, 100.6, 102.5, 400.5)] == [0.5, 0.5, 2.0, 300.0]
    made.add(401.0)
    assert made.longest_gap(401.0) == 300.5
    made.shift(-1000.0)
    assert made.longest_gap(-599.0) == 300.5
    assert record(0.0).longest_gap(100.0) is None
