"""Photographs whose poses are found from themselves, and what is kept of that."""

import json
from dataclasses import asdict
from pathlib import Path

import mutations
from geogs.application.structure_from_motion.photos import open_photographs
from geogs.config import ReconstructConfig
from geogs_photos.photograph import find_photographs
from geogs_photos.poses import FoundPoses
from io_samples import gradient_image, write_image
from parsers.base import Parser, tiny_room
from parsers.recordings import write_photograph
from posed_layouts import write_colmap_binary, write_room_images


def photographs() -> dict[str, Parser]:
    """What ``geogs reconstruct --sfm`` reads."""
    names = ("a.jpg", "b.jpg", "c.jpg")

    def taken(folder: Path) -> None:
        for number, name in enumerate(names):
            write_photograph(folder / name, number)

    return {
        "photographs": Parser(
            taken, names[:2], mutations.binary, lambda f: find_photographs(f).damaged
        ),
        "photographs-before": Parser(
            located, ("photographs.json",), mutations.json_text, open_again
        ),
    }  # fmt: skip


def located(folder: Path) -> None:
    """Photographs whose poses an earlier call found."""
    room = tiny_room()
    images = write_room_images(room, folder / "photos", "{:d}.png")
    write_image(folder / "photos" / "left.png", gradient_image(7))
    write_colmap_binary(room, folder / "sparse" / "0", images)
    found = FoundPoses((("left.png", "shows little"),), 0.4)
    (folder / "photographs.json").write_text(json.dumps(asdict(found)))


def open_again(folder: Path) -> object:
    """Take the poses that were found."""
    source = open_photographs(folder / "photos", ReconstructConfig(), folder, again=True)
    return source.left_out, [image.image for image in source]
