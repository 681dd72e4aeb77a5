"""How much a textured mesh looks like images that were not used for it.

Every so many-th keyframe of a result is left out of the texture, and the mesh is drawn from where
it was taken. Prints decibels of each and the mean, over the pixels that show a surface: as it is,
and after one factor for each colour, since a camera chooses its exposure anew for every image.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from PIL import Image

from geogs.application.export.export import TOLERANCE
from geogs.application.results.saved_result import load_result
from geogs.application.results.surfaces import fusion_views
from geogs.mesh.texture.textured import texture_mesh
from geogs.mesh.triangle_mesh import median_edge
from textured_view import psnr, render_textured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("result", type=Path, help="folder of a result with a mesh")
    parser.add_argument("--every", type=int, default=8, help="leave out every so many-th keyframe")
    parser.add_argument("--pictures", type=Path, help="folder for drawn images beside the true")
    options = parser.parse_args()
    result = load_result(options.result)
    mesh, views = result.mesh, list(fusion_views(result.keyframes))
    held_out = range(options.every // 2, len(views), options.every)
    used = [view for number, view in enumerate(views) if number not in held_out]
    begin = time.process_time()
    textured = texture_mesh(mesh, used, TOLERANCE * median_edge(mesh))
    seconds = time.process_time() - begin
    print(
        f"{len(mesh.faces)} faces, {100 * textured.seen:.1f} % seen, "
        f"{textured.texture.shape[1]}x{textured.texture.shape[0]}, {seconds:.1f} s of CPU"
    )
    scores = []
    for number in held_out:
        view = views[number]
        drawn, hit = render_textured(
            textured.vertices, textured.faces, textured.uv, textured.texture,
            result.camera, view.T_cw.numpy(),
        )  # fmt: skip
        gain = view.image[hit].mean(0) / np.maximum(drawn[hit].mean(0), 1.0)
        exposed = (drawn * gain).round().clip(0, 255).astype(np.uint8)
        scores.append((psnr(drawn, view.image, hit), psnr(exposed, view.image, hit)))
        print("{}: {:.2f} dB, exposed alike {:.2f}".format(number, *scores[-1]), end="")
        print(f", over {100 * hit.mean():.0f} %")
        if options.pictures:
            options.pictures.mkdir(parents=True, exist_ok=True)
            beside = np.concatenate([drawn, view.image], axis=1)
            Image.fromarray(beside).save(options.pictures / f"{number:04d}.png")
    print("mean {:.2f} dB, exposed alike {:.2f}".format(*np.mean(scores, axis=0)))
    if options.pictures:
        Image.fromarray(textured.texture).save(options.pictures / "atlas.jpg")


if __name__ == "__main__":
    main()
