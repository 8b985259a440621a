"""Learning rates by number."""

import pytest

from pnet.engine.schedules import StepDecay, WarmupCosine


def test_step_decay_is_a_staircase():
    schedule = StepDecay(every=100, gamma=0.5)
    assert [schedule.factor(step, 1000) for step in (0, 99, 100, 199, 200, 999)] == [
        1,
        1,
        0.5,
        0.5,
        0.25,
        2**-9,
    ]


def test_step_decay_has_a_floor():
    assert StepDecay(every=10, gamma=0.7, floor=0.01).factor(1000, 2000) == 0.01


def test_warmup_rises_and_the_cosine_falls():
    schedule = WarmupCosine(warmup=0.1, floor=0.01)
    assert [schedule.factor(step, 100) for step in (0, 4, 9, 10)] == pytest.approx([0.1, 0.5, 1, 1])
    assert schedule.factor(55, 100) == pytest.approx(0.505)  # half way down
    assert schedule.factor(100, 100) == schedule.factor(150, 100) == pytest.approx(0.01)
    falling = [schedule.factor(step, 100) for step in range(10, 101)]
    assert falling == sorted(falling, reverse=True)


@pytest.mark.parametrize("total", [1, 2])
def test_a_training_of_a_step_or_two_has_a_rate(total):
    for step in range(total + 1):
        assert 0 < WarmupCosine(warmup=0.05, floor=0.01).factor(step, total) <= 1
