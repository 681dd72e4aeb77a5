"""How long the stages of a mesh take, as parts of all of it."""

_FUSED, _SURFACE, _COLOURED, _MERGED = 0.25, 0.25, 0.15, 0.35
"""Of its seconds; the surface is found and cleaned once all views have been fused."""


def mesh_seconds(whole: float) -> dict[str, float]:
    """Seconds of each stage, of a mesh that takes so many."""
    parts = {"fuse": _FUSED + _SURFACE, "colour": _COLOURED, "merge": _MERGED}
    return {f"mesh: {name}": part * whole for name, part in parts.items()}


def mesh_stage(reported: str, fraction: float) -> tuple[str, float]:
    """Stage and its finished part, by what is reported of a mesh: the surface has no word."""
    if reported == "mesh: fuse":
        fraction *= _FUSED / (_FUSED + _SURFACE)
    return reported, fraction
