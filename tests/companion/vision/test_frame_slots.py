import os

import numpy as np
import pytest

from companion.vision.frame_slots import N_SLOTS, FrameSlots, MappedSlots


@pytest.fixture(params=["memfd", "unnamed file"])
def slots(request, monkeypatch):
    if request.param == "unnamed file":
        monkeypatch.delattr(os, "memfd_create")
    made = FrameSlots(64 * 48)
    yield made
    made.close()


def mapped(slots: FrameSlots) -> MappedSlots:
    return MappedSlots(os.dup(slots.fd), slots.slot_bytes, N_SLOTS)


def test_each_slot_keeps_its_own_frame(slots: FrameSlots):
    rng = np.random.default_rng(1)
    first, second = rng.integers(0, 255, (48, 64), np.uint8), rng.integers(0, 255, (20, 30), np.uint8)
    slots.write(0, first)
    slots.write(1, second)
    reading = mapped(slots)
    np.testing.assert_array_equal(reading.read(0, 48, 64), first)
    np.testing.assert_array_equal(reading.read(1, 20, 30), second)
    reading.close()


def test_a_frame_that_was_read_stays_as_it_was(slots: FrameSlots):
    reading = mapped(slots)
    slots.write(0, np.full((48, 64), 1, np.uint8))
    image = reading.read(0, 48, 64)
    slots.write(0, np.full((48, 64), 2, np.uint8))
    assert image.max() == 1
    reading.close()
    assert image.min() == 1  # its memory is its own


def test_the_memory_has_no_name(slots: FrameSlots):
    assert os.fstat(slots.fd).st_nlink == 0


@pytest.mark.parametrize("shape", [(49, 64), (64, 0), (1, 64 * 48 + 1)])
def test_what_does_not_fit_is_refused_on_both_sides(slots: FrameSlots, shape):
    reading = mapped(slots)
    with pytest.raises(ValueError, match="expected at most 3072 px"):
        slots.write(0, np.zeros(shape, np.uint8))
    with pytest.raises(ValueError, match="expected at most 3072 px"):
        reading.read(0, *shape)
    reading.close()


def test_memory_that_is_not_there_is_an_error_at_once(monkeypatch: pytest.MonkeyPatch):
    made: list[int] = []

    def full(fd, *_):
        made.append(fd)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left"):
        FrameSlots(1000)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(made[0])
