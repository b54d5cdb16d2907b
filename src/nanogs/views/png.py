"""Renderings as PNG files."""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nanogs._types import Array
from nanogs.errors import OptionError
from nanogs.formatting import undrawn
from nanogs.io.atomic import atomic_write
from nanogs.io.folder import atomic_folder
from nanogs.progress import Progress, Stage, Tracker, each
from nanogs.raster.camera import Camera
from nanogs.raster.images import color_image, depth_image
from nanogs.raster.lens import lens_notes
from nanogs.raster.rendering import PreparedSplats, prepare, render
from nanogs.splats import Splats

_PHOTO = re.compile(r"\.(png|jpe?g|webp)$", re.IGNORECASE)


def render_images(
    splats: Splats,
    cameras: Sequence[Camera],
    target: Path,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    transparent: bool = False,
    depth: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> tuple[list[str], list[str]]:
    """Render each camera into a PNG file named after it, or a single one into a file of any name.

    Args:
        splats: The model.
        cameras: The views; their names become file names.
        target: A folder, made if it is missing (not its parents); or, of one camera, a `.png` file.
        background: RGB in [0, 1].
        transparent: Write RGBA with straight alpha and no background.
        depth: Also write `<name>_depth.png`, 16 bits: 65535 is the nearest depth of the view, 1 the
            farthest, 0 nothing.
        overwrite: Replace files that exist.
        progress: Called with each `nanogs.progress.Step`; the views are parts of one stage.

    Returns:
        The files written, and what the user should know.

    Raises:
        OptionError: Two cameras give one file name, or there are several for one file.
        OutputError: The folder cannot be made, or a file exists or cannot be written.
    """
    folder, names = _places(target, cameras)
    options: dict[str, Any] = {"background": background, "transparent": transparent, "depth": depth}
    tracker = Tracker(progress, [Stage("render", 1.0)])
    views = each(zip(cameras, names, strict=True), tracker.part)
    with _filled(folder) as place:
        files, notes = _render(prepare(splats), views, place, overwrite=overwrite, **options)
    tracker.finish()
    return [str(folder / name) for name in files], [*lens_notes(cameras), *notes]


@contextmanager
def _filled(folder: Path) -> Iterator[Path]:
    """Yield where to write a folder's files: a new folder appears whole or not at all."""
    if folder.is_dir():
        yield folder
        return
    with atomic_folder(folder, _nothing_of) as place:
        yield place


def _nothing_of(_folder: Path) -> None:
    """Pictures that exist are not replaced."""


def _render(
    prepared: PreparedSplats,
    views: Iterable[tuple[Camera, str]],
    folder: Path,
    *,
    background: tuple[float, float, float],
    transparent: bool,
    depth: bool,
    overwrite: bool,
) -> tuple[list[str], list[str]]:
    """Render each camera into a folder; the names of the files, and what the user should know."""
    written: list[str] = []
    notes: dict[str, None] = {}
    for camera, name in views:
        rendering = render(prepared, camera, background=background, depth=depth)
        images: dict[str, Array] = {f"{name}.png": color_image(rendering, transparent)}
        if depth:
            images[f"{name}_depth.png"] = depth_image(rendering)
        for file_name, image in images.items():
            save_png(image, folder / file_name, overwrite=overwrite)
            written.append(file_name)
        notes.update(dict.fromkeys(rendering.notes))
        if not rendering.alpha.any():
            notes[f"{name}: nothing of the model is seen"] = None
    if prepared.skipped:
        notes[undrawn(prepared.skipped)] = None
    return written, list(notes)


def _places(target: Path, cameras: Sequence[Camera]) -> tuple[Path, list[str]]:
    """The folder of the files and their names without suffix."""
    if target.suffix.lower() != ".png":
        return target, file_names(cameras)
    if len(cameras) > 1:
        raise OptionError(
            f"{target} is one picture, and there are {len(cameras)} views; name a folder for them."
        )
    return target.parent, [target.stem]


def file_names(cameras: Sequence[Camera]) -> list[str]:
    """File names of the cameras, without suffix: what is not a letter, digit, - or . becomes _.

    Cameras are often named after photographs, whose suffix is left out where the rest tells them
    apart.

    Raises:
        OptionError: Two cameras would share a file.
    """
    whole = [camera.name for camera in cameras]
    stems = [_PHOTO.sub("", name) for name in whole]
    names = [
        re.sub(r"[^\w.-]+", "_", name).strip("._") or f"view_{index:03d}"
        for index, name in enumerate(stems if len(set(stems)) == len(set(whole)) else whole)
    ]
    for index, name in enumerate(names):
        if name in names[:index]:
            raise OptionError(f"Two cameras are called {name!r}; give them names of their own.")
    return names


def save_png(image: Array, path: Path, *, overwrite: bool) -> None:
    """Write a PNG file.

    Raises:
        OutputError: It exists, or cannot be written.
    """
    from PIL import Image

    with atomic_write(path, overwrite=overwrite) as file:
        Image.fromarray(image).save(file, format="PNG")
