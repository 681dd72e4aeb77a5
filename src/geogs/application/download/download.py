"""A public sequence, fetched and unpacked into a folder of its name."""

import shutil
from pathlib import Path

from geogs.application.download.fetch import fetch
from geogs.application.download.sequences import PublicSequence
from geogs.application.download.unpack import unpack
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.output_folder import claimed


def download(sequence: PublicSequence, into: Path, progress: RunProgress | None = None) -> Path:
    """Fetch a sequence into ``into``, or resume an earlier attempt. Returns its folder.

    The archive is deleted once its files are there.

    Raises:
        InputError: it cannot be fetched, or is damaged.
        OutputError: a file cannot be written.
    """
    progress = progress or RunProgress()
    with claimed(into) as folder:
        place = folder / sequence.folder
        if not place.exists():
            archive = folder / sequence.archive.name
            if not archive.is_file():
                said = sequence.archive
                fetch(said.url, archive, said.sha256, lambda part: progress.stage("download", part))
            progress.stage("unpacking", 0.0)
            new = folder / f".{sequence.folder}.new"
            try:
                shutil.rmtree(new, ignore_errors=True)
                unpack(archive, new)
                new.rename(place)
            finally:
                shutil.rmtree(new, ignore_errors=True)
            archive.unlink()
        for file in sequence.beside:
            if not (place / file.name).exists():
                progress.stage("download: truth", 0.0)
                fetch(file.url, place / file.name, file.sha256, lambda _: None)
    return place
