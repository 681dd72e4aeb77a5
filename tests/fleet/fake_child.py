"""A stand-in for ``geogs_fleet.child`` that computes nothing: tests of fleets run it as a program.

What it does follows from the text of its source: ``fail`` and a sentence, ``kill`` (each time),
``kill once``, ``wait`` and seconds, ``eat`` and MiB; anything else is a success. Every start adds
a line to ``starts`` in the folder of results. Of a ``steps`` source each step is kept in a file, as
of a checkpoint, and where there is one already it goes on after it.
"""

import json
import os
import pickle
import signal
import sys
import threading
import time
from pathlib import Path


def main() -> None:
    settings = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    output = settings.output
    with (output / "starts").open("a") as starts:
        starts.write(f"{os.getpid()}\n")
    before = len((output / "starts").read_text().splitlines()) - 1
    word, _, rest = settings.source[0].read_text().strip().partition(" ")
    state, sentence = "done", ""
    if word == "fail":
        state, sentence = "failed", rest
    elif word == "kill" and (rest != "once" or not before):
        os.kill(os.getpid(), signal.SIGKILL)
    elif word == "wait":
        time.sleep(float(rest))
    elif word == "eat":
        eaten = bytearray(int(rest) << 20)
        eaten[::1024] = b"x" * len(eaten[::1024])
        time.sleep(60)
    elif word == "steps":
        _take_steps(output / "steps", int(rest))
    if state == "done":
        verdict = {"sentence": f"Good: {word}.", "is_reliable": word != "doubt", "lost": 0.25}
        summary = {"frames": 12, "keyframes": 3, "verdict": verdict}
        (output / "summary.json").write_text(json.dumps(summary))
    print(json.dumps({"state": state, "sentence": sentence}))


def _take_steps(file: Path, number: int) -> None:
    done = len(file.read_text().split()) if file.is_file() else 0
    for step in range(done, number):
        time.sleep(0.2)
        with file.open("a") as stream:
            stream.write(f"{step}\n")


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


main()
