"""Keys: a press counts for the next decision, a held key for as long as it is held, and a little longer."""

import numpy as np

from segvisrl_jax.view.driver import FIRST_HOLD_S, REPEAT_HOLD_S, Direction, KeyDriver


def test_without_keys_there_is_no_command():
    assert KeyDriver().command(0.0) is None


def test_a_short_press_counts_once_even_if_the_decision_is_late():
    driver = KeyDriver()
    driver.press(Direction.FORWARD, 0.0)
    assert np.array_equal(driver.command(5.0), [1, 1])
    assert driver.command(5.1) is None


def test_a_held_key_lasts_over_the_first_pause_and_ends_soon_after_the_last_repeat():
    driver = KeyDriver()
    driver.press(Direction.LEFT, 0.0)
    assert driver.command(0.0) is not None
    assert driver.command(FIRST_HOLD_S - 0.01) is not None
    for now in np.arange(0.5, 2.0, 0.05):
        driver.press(Direction.LEFT, now)
        assert driver.command(now + 0.04) is not None
    assert driver.command(now + REPEAT_HOLD_S - 0.01) is not None
    assert driver.command(now + REPEAT_HOLD_S + 0.01) is None


def test_left_and_forward_together_turn_more_widely():
    driver = KeyDriver()
    driver.press(Direction.LEFT, 0.0)
    driver.press(Direction.FORWARD, 0.1)
    left, right = driver.command(0.2)
    assert 0.2 < left < right == 1


def test_stop_overrules_what_was_pressed_before():
    driver = KeyDriver()
    driver.press(Direction.FORWARD, 0.0)
    driver.press(Direction.STOP, 0.1)
    assert np.array_equal(driver.command(0.2), [0, 0])
    driver.press(Direction.RIGHT, 0.3)
    assert np.allclose(driver.command(0.4), Direction.RIGHT.value)
