"""Decoders side by side: each is told of its own damage, and nobody loses a line."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import cv2

from geogs.guard.decoder_noise import decoder_noise
from geogs.io.pictures import decoded
from io_samples import gradient_image, write_image


def test_of_many_pictures_decoded_side_by_side_the_damaged_ones_are_known(tmp_path, capfd):
    paths, damaged = [], set()
    for n in range(60):
        path = write_image(tmp_path / f"{n}.jpg", gradient_image(n, 320, 240))
        if n % 9 == 4:
            data = bytearray(path.read_bytes())
            data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
            path.write_bytes(data)
            damaged.add(n)
        paths.append(path)
    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(lambda path: decoded(path, cv2.IMREAD_COLOR), paths))
    assert {n for n, one in enumerate(found) if one.is_damaged} == damaged
    assert all(one.picture is not None for one in found)
    assert capfd.readouterr().err == ""


def test_who_decodes_side_by_side_hears_the_others_and_who_is_alone_does_not(capfd):
    begun, heard = threading.Barrier(2), []

    def other() -> None:
        with decoder_noise(alone=False) as noise:
            begun.wait(10)
            os.write(2, b"libpng warning: side by side\nsomebody else\n")
            begun.wait(10)
        heard.extend(noise)

    thread = threading.Thread(target=other)
    thread.start()
    with decoder_noise(alone=False) as mine:
        begun.wait(10)
        begun.wait(10)
    thread.join()
    assert mine == heard == ["libpng warning: side by side"]
    assert capfd.readouterr().err == "somebody else\n"
    with decoder_noise() as alone:
        pass
    assert alone == []


def test_alone_is_alone():
    inside, most, lock = 0, [], threading.Lock()

    def work(n: int) -> None:
        nonlocal inside
        alone = n % 3 == 0
        with decoder_noise(alone):
            with lock:
                inside += 1
                most.append((alone, inside))
            threading.Event().wait(0.003)
            with lock:
                inside -= 1

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(60)))
    assert max(count for alone, count in most if alone) == 1
    assert max(count for alone, count in most if not alone) > 1
