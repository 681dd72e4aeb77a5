"""One page with a picture of each result, its numbers and its verdict.

    python examples/gallery.py out/* > gallery.html

Beside the results, as it links to their reports.
"""

import html
import sys
from pathlib import Path

import geogs

PAGE = """<!doctype html>
<meta charset="utf-8"><title>Results</title>
<style>
body {{ font: 16px sans-serif; margin: 2em auto; max-width: 75em; }}
main {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(22em, 1fr)); gap: 2em; }}
img {{ width: 100%; }}
</style>
<main>
{}
</main>"""
TILE = """<article>
<a href="{folder}/report/index.html"><img src="{folder}/report/{picture}" alt="{name}"></a>
<h2>{name}</h2>
<p>{numbers}</p>
<p>{verdict}</p>
</article>"""


def tile(folder: Path) -> str:
    """A picture of a result and what its summary says; raises InputError if it is none."""
    result = geogs.load_result(folder)
    summary = result.summary
    verdict = result.verdict
    pictures = ("keyframes.png", "trajectory.png")
    there = [name for name in pictures if (folder / "report" / name).is_file()]
    numbers = f"{summary['frames']} images, {summary['mesh_faces']} triangles"
    words = {
        "folder": folder.as_posix(),
        "picture": there[0] if there else "",
        "name": folder.name,
        "numbers": f"{numbers}, {summary['seconds']['total']:.0f} s",
        "verdict": "Poses were given." if verdict is None else verdict.sentence,
    }
    return TILE.format(**{name: html.escape(text) for name, text in words.items()})


def main() -> None:
    folders = [Path(name) for name in sys.argv[1:]]
    results = [folder for folder in folders if (folder / "summary.json").is_file()]
    print(PAGE.format("\n".join(map(tile, results))))


if __name__ == "__main__":
    main()
