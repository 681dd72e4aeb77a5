"""A fixed computation, the unit of the commands' processor time."""

import time

import cv2
import numpy as np

ROUNDS = 3


def reference_seconds() -> float:
    """Processor time of the computation in seconds, the least of a few rounds.

    A mix of sorting, products of matrices, functions of arrays and filters of images, none of it
    ours; so ratios to it hardly depend on the machine's speed or load.
    """
    return min(_once() for _ in range(ROUNDS))


def _once() -> float:
    random = np.random.default_rng(0)
    numbers = random.random(2_000_000, np.float32)
    matrices = random.random((64, 160, 160), np.float32)
    picture = random.integers(0, 256, (960, 1280, 3), np.uint8)
    rows = numbers[: 640 * 480].reshape(480, 640) * 900
    columns = numbers[-640 * 480 :].reshape(480, 640) * 900
    start = time.thread_time()
    for _ in range(2):
        order = np.argsort(numbers, kind="stable")
        np.exp(-numbers[order]).cumsum()
        (matrices @ matrices.transpose(0, 2, 1)).sum()
        for _ in range(4):
            cv2.GaussianBlur(picture, (9, 9), 2.0)
            cv2.remap(picture, rows, columns, cv2.INTER_LINEAR)
    return time.thread_time() - start
