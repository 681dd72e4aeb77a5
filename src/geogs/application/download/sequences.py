"""Public sequences that can be fetched without an account, their addresses and licences.

The files were not published with checksums: a file is compared with the size given by its server,
and archives with the checksums inside them. Where the maker publishes a SHA-256 it belongs here.
"""

import difflib
from dataclasses import dataclass

from geogs.errors import InputError


@dataclass(frozen=True)
class PublicFile:
    """A file on a server."""

    url: str
    sha256: str = ""
    """Published checksum; empty where there is none."""

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.url.rsplit("/", 1)[-1]


@dataclass(frozen=True)
class PublicSequence:
    """A sequence of a data set."""

    name: str
    """Name on the command line."""
    folder: str
    """Name of its folder, which identifies the camera of some sequences."""
    archive: PublicFile
    licence: str
    page: str
    """Web page of the data set, with the citation."""
    beside: tuple[PublicFile, ...] = ()
    """Files for its folder that are not in the archive, such as true poses."""


_TUM = "https://cvg.cit.tum.de/rgbd/dataset"
_ICL = "https://www.doc.ic.ac.uk/~ahanda"
_ETH3D = "https://www.eth3d.net/data/slam/datasets"


def _tum(name: str, kinect: int, scene: str) -> PublicSequence:
    folder = f"rgbd_dataset_freiburg{kinect}_{scene}"
    archive = PublicFile(f"{_TUM}/freiburg{kinect}/{folder}.tgz")
    page = "https://cvg.cit.tum.de/data/datasets/rgbd-dataset"
    return PublicSequence(f"tum/{name}", folder, archive, "CC BY 4.0", page)


def _icl(name: str, archive: str, truth: str) -> PublicSequence:
    return PublicSequence(
        f"icl/{name}",
        archive,
        PublicFile(f"{_ICL}/{archive}.tar.gz"),
        "CC BY 3.0",
        f"{_ICL}/VaFRIC/iclnuim.html",
        (PublicFile(f"{_ICL}/VaFRIC/{truth}.gt.freiburg"),),
    )


def _eth3d(name: str) -> PublicSequence:
    archive = PublicFile(f"{_ETH3D}/{name}_mono.zip")
    page = "https://www.eth3d.net/slam_overview"
    return PublicSequence(f"eth3d/{name}", name, archive, "CC BY-NC-SA 4.0", page)


SEQUENCES: tuple[PublicSequence, ...] = (
    _tum("fr1_xyz", 1, "xyz"),
    _tum("fr1_desk", 1, "desk"),
    _tum("fr1_desk2", 1, "desk2"),
    _tum("fr1_room", 1, "room"),
    _tum("fr2_xyz", 2, "xyz"),
    _tum("fr2_desk", 2, "desk"),
    _tum("fr3_office", 3, "long_office_household"),
    *(_icl(f"lr_kt{n}", f"living_room_traj{n}_frei_png", f"livingRoom{n}") for n in range(4)),
    *(_icl(f"of_kt{n}", f"traj{n}_frei_png", f"traj{n}") for n in range(4)),
    *map(_eth3d, ("cables_1", "einstein_1", "plant_1", "plant_2", "sofa_1", "table_3")),
)


def find_sequence(name: str) -> PublicSequence:
    """The sequence of a name. Raises InputError if there is none."""
    known = {sequence.name: sequence for sequence in SEQUENCES}
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]}?" if near else "geogs download lists those that are."
    raise InputError(f"{name} is no sequence that is known; {hint}")
