"""One thread for each numeric library: many small jobs on two cores wait for each other otherwise."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def pytest_configure() -> None:
    import cv2

    cv2.setNumThreads(1)
