"""The calls that a sequence makes to its prior."""

import pytest

from emgs_jax.prior.base import Window, visits, windows


def test_no_frames_give_no_window_and_twelve_those_of_four():
    assert list(windows(range(0).__contains__, 4)) == [] and list(windows(range(12).__contains__, 4)) == [
        Window(0, (0, 1, 2, 3), (0, 1, 2, 3), 3),
        Window(1, (0, 1, 2, 3, 4, 5), (3, 4), 4),
        Window(2, (0, 1, 2, 3, 4, 5, 6), (4, 5), 5),
        Window(3, (0, 2, 3, 4, 5, 6, 7), (5, 6), 6),
        Window(4, (0, 3, 4, 5, 6, 7, 8), (6, 7), 7),
        Window(5, (0, 4, 5, 6, 7, 8, 9), (7, 8), 8),
        Window(6, (0, 5, 6, 7, 8, 9, 10), (8, 9), 9),
        Window(7, (0, 6, 7, 8, 9, 10, 11), (9, 10), 10),
        Window(8, (0, 7, 8, 9, 10, 11), (10, 11), 11),
    ]


@pytest.mark.parametrize("num_newer", [1, 2, 3])
def test_with_more_newer_images_the_windows_are_the_same_and_the_current_one_is_as_much_older(num_newer):
    one, more = list(windows(range(12).__contains__, 4)), list(windows(range(12).__contains__, 4, num_newer))
    assert [call.views for call in more[: len(one) - 1]] == [call.views for call in one[:-1]]
    later = num_newer - 1
    assert [call.current + later for call in more[: len(one) - 1]] == [call.current for call in one[:-1]]
    assert more[0].dense == tuple(range(4 - later))
    assert all(call.views == one[-1].views for call in more[len(one) - 1 :]), "the last ones have fewer after them"
    with pytest.raises(ValueError, match="a window of 4 images cannot have 5 after the current one"):
        list(windows(range(12).__contains__, 4, 5))


@pytest.mark.parametrize("num_newer", [1, 2, 4])
@pytest.mark.parametrize("num_frames", [1, 2, 3, 4, 5, 9, 30])
@pytest.mark.parametrize("window_size", [1, 2, 4, 10])
def test_every_frame_is_integrated_once_in_order_and_no_view_is_listed_twice(num_frames, window_size, num_newer):
    num_newer = min(num_newer, window_size)
    calls = list(windows(range(num_frames).__contains__, window_size, num_newer))
    first, steps = calls[0], calls[1:]
    assert [*first.dense, *(call.current for call in steps)] == list(range(num_frames))
    assert [call.inference for call in calls] == list(range(len(calls)))
    for call in calls:
        assert len(set(call.views)) == len(call.views)
        assert call.views[0] == 0
        assert list(call.views) == sorted(call.views)
        assert set(call.dense) <= set(call.views)
        assert call.dense[-1] == call.current
    for call in steps:
        assert call.dense == (call.current - 1, call.current)
        assert {min(call.current + later, num_frames - 1) for later in range(num_newer + 1)} <= set(call.views)
    for size in (0, 2.5):
        with pytest.raises(ValueError, match=f"slam.window_size must be a whole number of images, .* got {size}"):
            list(windows(range(5).__contains__, size))


def test_views_of_two_visits_are_of_the_past():
    assert visits(5, 90, 3, 10) == Window(81, (5, 2, 8, 87, 90), (5, 90), 90)
    assert visits(1, 3, 3, 10) == Window(0, (1, 0, 3), (1, 3), 3)
