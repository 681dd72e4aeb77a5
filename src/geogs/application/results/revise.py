"""Another mesh of a saved result, without another run."""

from dataclasses import fields, replace
from pathlib import Path

from geogs.application.progress.run_progress import RunProgress
from geogs.application.result_settings import RemeshSettings
from geogs.application.results.output_folder import claimed
from geogs.application.results.result_page import write_page_anew
from geogs.application.results.saved_result import load_result, result_folder
from geogs.application.results.surfaces import fused
from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.gpu.installation import require_device
from geogs.guard.documents import UNUSABLE, read_yaml
from geogs.guard.replacement import replaced


def mesh_settings(folder: Path) -> MeshConfig:
    """Mesh settings of a result; the defaults where they are not stored.

    Raises:
        InputError: ``config.yaml`` is damaged, or holds a value that a setting cannot have.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        return MeshConfig()
    try:
        said = read_yaml(path)["mesh"]
        known = {name.name: said[name.name] for name in fields(MeshConfig) if name.name in said}
    except UNUSABLE:
        raise InputError(f"{path} is damaged; give the settings of the mesh anew.") from None
    return replace(MeshConfig(), **known)


def remesh(settings: RemeshSettings, progress: RunProgress | None = None) -> Path:
    """Render the keyframes of a result, fuse their depths and write the mesh. Returns its path.

    If it is the mesh of the result, its page is made again, too, without the evaluation of the
    previous one.

    On the CPU, with the settings of the run, the surface is that of the run to the last byte;
    colours differ by the JPEG compression of the images.

    Raises:
        InputError: there is no result, it is too old, or its disks show no surface.
        OutputError: the file cannot be written.
        DeviceError: the device cannot be used.
    """
    follow = progress or RunProgress()
    folder = result_folder(settings.result)
    path = settings.output or folder / "mesh.ply"
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path} should end in .ply; geogs export writes other formats.")
    if path != folder / "mesh.ply":
        result = load_result(folder, require_device(settings.device))
        fused(result.renders, settings.mesh, follow).save(path)
        return path
    with claimed(folder), replaced(folder, "part") as new:
        result = load_result(folder, require_device(settings.device))
        mesh = fused(result.renders, settings.mesh, follow)
        mesh.save(new / "mesh.ply")
        write_page_anew(new, result, mesh)
    return path
