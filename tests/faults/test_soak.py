"""Long work, shortened: what ``soak.py`` measures at full size runs, and would see a leak."""

import pytest
from soak import MOST_GROWTH, Soaked, draw, drive, train

from segvisrl_jax.vision import gl_context


@pytest.mark.slow
def test_random_driving_is_stable():
    soaked = drive("native", 3 * 256 * 64)
    assert soaked.unstable == 0
    assert len(soaked.memory_mib) == 3


@pytest.mark.slow
@pytest.mark.gl
def test_pictures_come_from_one_renderer_after_another(monkeypatch):
    opened, freed = [], []  # contexts: as they are kept here, none is freed because nobody has it any more
    open_context = gl_context.open_gl_context

    def open_counted(*size):
        context = open_context(*size)
        free = context.free
        context.free = lambda: freed.append(context) or free()
        opened.append(context)
        return context

    monkeypatch.setattr(gl_context, "open_gl_context", open_counted)
    assert len(draw(200).memory_mib) == 200
    assert len(opened) == 2
    assert freed == opened


@pytest.mark.slow
def test_a_training_is_stopped_in_order():
    assert "updates" in train(40 / 3600).done


def test_a_leak_is_seen():
    assert Soaked("flat", "", 0, [100.0, 300.0] + [500.0] * 98).growth == 0
    assert Soaked("leak", "", 0, [500.0 + i for i in range(100)]).growth > MOST_GROWTH
