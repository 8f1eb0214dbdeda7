from companion.vision.backoff import RestartBackoff


def test_delays_double_up_to_the_longest_and_never_end():
    backoff = RestartBackoff(0.5, 3.0)
    assert [backoff.delay_after_s(0.0) for _ in range(6)] == [0.5, 1.0, 2.0, 3.0, 3.0, 3.0]


def test_a_worker_that_lasted_starts_them_over():
    backoff = RestartBackoff(0.5, 3.0)
    for _ in range(4):
        backoff.delay_after_s(2.9)
    assert backoff.delay_after_s(3.0) == 0.5
    assert backoff.delay_after_s(0.0) == 1.0
