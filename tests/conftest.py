"""What all tests share: one thread for each numeric library, and property tests that repeat.

Many small numeric jobs on two cores wait for each other otherwise. Property tests draw the same examples in each
run, so that a change is judged by the change; ``HYPOTHESIS_PROFILE=explore`` draws new ones.

The integration tests, whose files take longest, come first: where files are run side by side none of them is last, alone.
"""

import os

import pytest
from hypothesis import settings

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

settings.register_profile("gate", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "gate"))


def pytest_configure() -> None:
    import cv2

    cv2.setNumThreads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: "integration" not in item.path.parts)
