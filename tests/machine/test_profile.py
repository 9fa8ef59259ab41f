"""Where an update's time goes: what the profiler saw is counted once, and the parts are those of the training."""

import pytest

from segvisrl_jax.config import preset_config, replace_fields
from segvisrl_jax.machine.profile import NUM_OPERATIONS, Event, busy_ns, own_times, profile_rows

LOOP, ADD, COPY = ("while", "jit_f"), ("add", "jit_f"), ("copy", "jit_g")


def test_an_operation_is_not_charged_for_what_ran_inside_of_it():
    inner = [Event(10, 40, ADD), Event(40, 50, LOOP), Event(45, 50, COPY), Event(60, 90, ADD)]
    line = [*inner, Event(0, 100, LOOP), Event(100, 130, COPY)]
    assert own_times(line) == {LOOP: 30 + 5, ADD: 60, COPY: 35}
    assert sum(own_times(line).values()) == busy_ns([line]) == 130


def test_threads_that_work_side_by_side_are_busy_once():
    lines = [[Event(0, 10, ADD), Event(50, 60, ADD)], [Event(5, 20, COPY)], []]
    assert busy_ns(lines) == 30
    assert busy_ns([]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["cnn_lstm", "mlp"])
def test_parts_and_operations_of_an_update(arch, tmp_path):
    config = replace_fields(preset_config(arch, "smoke"), unroll_length=8)
    rows = list(profile_rows(config, 1, tmp_path))
    parts = {row["name"]: row for row in rows[:5]}
    assert list(parts) == ["acting", "physics", "rendering", "network", "learning"]
    assert parts["acting"]["percent_of_update"] + parts["learning"]["percent_of_update"] == pytest.approx(100)
    busy, *operations = rows[5:]
    assert busy["name"] == "operations"
    assert 0 < busy["percent_of_update"] <= 100
    assert len(operations) == NUM_OPERATIONS
    times = [row["us_a_decision"] for row in operations]
    assert times == sorted(times, reverse=True)
    assert times[-1] > 0
    assert all(row["of"].startswith("jit_") for row in operations)
    assert len(list(tmp_path.rglob("*.xplane.pb"))) == 1
