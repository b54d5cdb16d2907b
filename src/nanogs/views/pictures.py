"""Rendering into picture files."""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from nanogs._types import Array
from nanogs.errors import OptionError
from nanogs.formatting import counted, notes_on_views, undrawn
from nanogs.io.atomic import atomic_write, check_writable
from nanogs.io.folder import atomic_folder
from nanogs.io.registry import PICTURES
from nanogs.progress import Progress, Stage, Tracker
from nanogs.protocol import BLACK, Background
from nanogs.ranges import one_or_several
from nanogs.raster.camera import Camera, camera_notes
from nanogs.raster.images import LARGEST_WEBP, color_image, depth_image
from nanogs.raster.rendering import Rendering
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.views.cameras import check_cameras, frame_notes
from nanogs.views.streamed import drawable, renderings

_PHOTO = re.compile(f"({'|'.join(map(re.escape, PICTURES))})$", re.IGNORECASE)
_QUALITY = 92  # of JPEG and WebP files, of 100; PNG has none


def render_images(
    model: Splats | Source,
    cameras: Camera | Sequence[Camera],
    target: str | PathLike[str],
    *,
    background: Background = BLACK,
    transparent: bool = False,
    depth: bool = False,
    overwrite: bool = False,
    budget: int | None = None,
    progress: Progress | None = None,
) -> tuple[list[str], list[str]]:
    """Render each camera into a PNG file named after it, or a single one into a file of any name.

    JPEG and WebP files have a quality of 92 of 100.

    Args:
        model: The model.
        cameras: The views, or one view; their names become file names.
        target: A folder, created if it is missing (but not its parents); or, for one camera, a
            `.png`, `.jpg`, `.jpeg` or `.webp` file in an existing folder.
        background: RGB in [0, 1]; not used with `transparent`.
        transparent: Write RGBA with straight alpha and no background.
        depth: Also write `<name>_depth.png`, 16 bits: 65535 is the nearest depth of the view, 1 the
            farthest, 0 nothing.
        overwrite: Replace files that exist.
        budget: Bytes for the splats of images, to stream the model; None to hold it in memory.
        progress: Called with each `nanogs.progress.Step`; the views are parts of one stage.

    Returns:
        The files written, and notes for the user.

    Raises:
        ModelError: `model` is no model.
        OptionError: There is no view, or one is no camera, or an invalid one; two give one file
            name, or there are several for one file; or the file's format cannot hold the picture.
        OutputError: The folder cannot be made, or a file exists or cannot be written.
    """
    target, cameras = Path(target), one_or_several(cameras)
    check_cameras(cameras)
    if not cameras:
        raise OptionError("There is no view to render; give one camera or more.")
    folder, names, suffix = _places(target, cameras)
    _refuse_unstorable(suffix, target, cameras[0], transparent=transparent)
    files = [_files(name, suffix, depth=depth) for name in names]
    written = [name for each in files for name in each]
    _refuse_shared(written)
    if folder != target or folder.is_dir():  # a folder that is missing is made
        for name in written:
            check_writable(folder / name, overwrite=overwrite)
    before = _pictures(target)
    tracker = Tracker(progress, [Stage("render", 1.0)])
    behind = BLACK if transparent else background  # straight alpha needs a render over black
    shown = renderings(
        drawable(model, budget), cameras, background=behind, depth=depth, on_progress=tracker.part
    )
    with _filled(folder) as place:
        notes = _write(shown, files, place, transparent=transparent, overwrite=overwrite)
    tracker.finish()
    notes += _left(before, written, folder)
    return [str(folder / name) for name in written], [
        *camera_notes(cameras),
        *frame_notes(cameras, model),
        *notes,
    ]


def _pictures(folder: Path) -> set[str]:
    """Return the names of the PNG files in a folder; none if it is not a folder."""
    return {path.name for path in folder.glob("*.png")} if folder.is_dir() else set()


def _left(before: set[str], written: Sequence[str], folder: Path) -> list[str]:
    """Return a note on older images left beside replaced ones, from a run with more views."""
    others = sorted(before - set(written))
    if not others or before.isdisjoint(written):
        return []
    left = counted(len(others), "older picture was", "older pictures were")
    named = f"{others[0]} to {others[-1]}" if others[1:] else others[0]
    return [f"{left} left in {folder}: {named}"]


def _refuse_unstorable(suffix: str, target: Path, camera: Camera, *, transparent: bool) -> None:
    """Refuse a picture that its format cannot hold.

    Raises:
        OptionError: It is to be transparent, or is too large.
    """
    known = _pillow_name(suffix)
    if known == "PNG":  # in a folder too, whose name may be empty, as in "."
        return
    png = target.with_suffix(".png")
    if transparent and known == "JPEG":
        raise OptionError(f"{target}: JPEG has no alpha; name {png} or {png.with_suffix('.webp')}.")
    if known == "WEBP" and max(camera.width, camera.height) > LARGEST_WEBP:
        raise OptionError(
            f"{target}: WebP holds at most {LARGEST_WEBP} pixels along a side; name {png}."
        )


@contextmanager
def _filled(folder: Path) -> Iterator[Path]:
    """Provide the folder to write files to; a new folder appears complete or not at all."""
    if folder.is_dir():
        yield folder
        return
    with atomic_folder(folder, _nothing_of) as place:
        yield place


def _nothing_of(_folder: Path) -> None:
    """Recognise no existing folder as an output, so that `atomic_folder` replaces none."""


def _write(
    shown: Iterable[Rendering],
    files: Iterable[list[str]],
    folder: Path,
    *,
    transparent: bool,
    overwrite: bool,
) -> list[str]:
    """Write each image, and its depth if there is a second name, and return notes for the user."""
    notes: dict[str, None] = {}
    unseen: list[str] = []
    skipped = 0
    for rendering, (name, *depth) in zip(shown, files, strict=True):
        skipped = rendering.skipped
        _save(color_image(rendering, transparent), folder / name, overwrite=overwrite)
        for other in depth:
            _save(depth_image(rendering), folder / other, overwrite=overwrite)
        notes.update(dict.fromkeys(rendering.notes))
        if not rendering.alpha.any():
            unseen.append(Path(name).stem)
    notes |= dict.fromkeys(notes_on_views(unseen, "nothing of the model is visible"))
    if skipped:
        notes[undrawn(skipped)] = None
    return list(notes)


def _places(target: Path, cameras: Sequence[Camera]) -> tuple[Path, list[str], str]:
    """Return the folder of the files, their names without suffix, and the suffix."""
    if target.suffix.lower() not in PICTURES:
        return target, file_names(cameras), ".png"
    if len(cameras) > 1:
        raise OptionError(
            f"{target} is one picture, but there are {len(cameras)} views; name a folder for them."
        )
    return target.parent, [target.stem], target.suffix


def _files(name: str, suffix: str, *, depth: bool) -> list[str]:
    """Return the names of the files of one view: the image, and its depth if requested."""
    png = suffix if suffix.lower() == ".png" else ".png"
    return [f"{name}{suffix}", *([f"{name}_depth{png}"] if depth else [])]


def _refuse_shared(files: Sequence[str]) -> None:
    """Refuse, before anything is rendered, files that two images would share.

    Raises:
        OptionError: There is one.
    """
    for index, name in enumerate(files):
        if name in files[:index]:
            raise OptionError(
                f"Two images would be called {name}, one of a view and one of the depth of another;"
                " give the cameras different names."
            )


def file_names(cameras: Sequence[Camera]) -> list[str]:
    """Make file names without suffix from the cameras' names.

    Characters other than letters, digits, - and . become _. Cameras are often named after
    photographs: their suffix is dropped if the names are still distinct without it.

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
            raise OptionError(f"Two cameras are called {name!r}; give them different names.")
    return names


def _pillow_name(suffix: str) -> str:
    """Return Pillow's name of the format of a suffix in `PICTURES`."""
    return {".png": "PNG", ".webp": "WEBP"}.get(suffix.lower(), "JPEG")


def _save(image: Array, path: Path, *, overwrite: bool) -> None:
    """Write a picture in the format that its name says.

    Raises:
        OutputError: The file exists, or cannot be written.
    """
    from PIL import Image

    with atomic_write(path, overwrite=overwrite) as file:
        Image.fromarray(image).save(file, format=_pillow_name(path.suffix), quality=_QUALITY)
