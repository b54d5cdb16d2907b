"""Scenes to measure on, and the reference images that results are compared with."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING

from nanogs.bench.published import DATASETS, IMAGE_SCALES, image_folder
from nanogs.bench.rows import Against
from nanogs.bench.settings import BenchSettings
from nanogs.errors import FormatError, NanogsError, NoViewsError, OptionError
from nanogs.formatting import counted
from nanogs.io import inspect
from nanogs.io.collect import WHOLE_FOLDERS, collect
from nanogs.io.url_files import refuse_address
from nanogs.io.urls import as_path, is_url
from nanogs.protocol import BLACK, Background, background_text
from nanogs.raster.camera import Camera
from nanogs.scoring.photo_views import PhotoViews
from nanogs.splats import Splats
from nanogs.views.cameras import KINDS

if TYPE_CHECKING:  # these import Numba
    from nanogs.scoring.scores import ReferenceView

TRAINED_MODEL = "{folder}/{scene}/point_cloud/iteration_30000/point_cloud.ply"
_DOWNLOAD = "every method reads a file in a process of its own: download it first"


@dataclass(frozen=True, slots=True)
class BenchScene:
    """A model, and the photographs that it was trained on, if there are any.

    Attributes:
        name: Its name in tables.
        model: The model's file.
        photos: Folder of its data set, or None.
        dataset: The published data set it belongs to, a key of `published.DATASETS`.
        images: Folder of the photographs within `photos`; None for the dataset's default.
        up: Up direction of automatic views; None to find it from the model.
    """

    name: str
    model: Path
    photos: Path | None = None
    dataset: str | None = None
    images: str | None = None
    up: tuple[float, float, float] | None = None


def scene_of_file(path: str | Path) -> BenchScene:
    """Return the scene of a model file, named after the file up to the first dot or its folder."""
    path = Path(path)
    folder = path.name in WHOLE_FOLDERS
    return BenchScene(path.resolve().parent.name if folder else path.name.split(".")[0], path)


def scenes_of_files(paths: Sequence[Path]) -> list[BenchScene]:
    """Return the scenes of model files and of the models in folders; the headers are read.

    Raises:
        NanogsError: A path is neither a model nor a folder that holds one, or is a URL.
    """
    for path in paths:
        refuse_address(path, _DOWNLOAD)
    models = collect(paths)
    for model in models:
        inspect(model)
    return [scene_of_file(model) for model in models]


def parse_scene(text: str) -> BenchScene:
    """Parse a scene given as `NAME=MODEL` or `NAME=MODEL:FOLDER`.

    Raises:
        OptionError: The text has another form, or the model is a URL.
    """
    name, _, rest = text.partition("=")
    if is_url(rest):
        refuse_address(as_path(rest), _DOWNLOAD)
    model, _, folder = rest.rpartition(":")
    if folder.startswith(("/", "\\")) and re.search(":[A-Za-z]$", model):  # a drive's colon
        model, folder = model[:-2], f"{model[-1]}:{folder}"
    if len(model) < 2:  # no colon, or only that of a drive letter
        model, folder = rest, ""
    if not name or not model:
        raise OptionError(f"A scene must be NAME=MODEL or NAME=MODEL:FOLDER, not {text!r}.")
    return BenchScene(name, Path(model), Path(folder) if folder else None)


def parse_dataset(text: str, model_pattern: str = TRAINED_MODEL) -> list[BenchScene]:
    """Return the scenes of a published data set: each subfolder that has a trained model.

    Args:
        text: `NAME=FOLDER`, the name a key of `published.DATASETS`.
        model_pattern: Path of a scene's model; {folder} and {scene} are replaced.

    Raises:
        OptionError: The text has another form, the pattern is empty, or no scene has a model.
    """
    name, _, folder = text.partition("=")
    if name not in DATASETS or not folder:
        raise OptionError(
            f"A data set must be NAME=FOLDER, where NAME is one of {', '.join(DATASETS)}."
        )
    root = Path(folder)
    if not root.is_dir():
        raise OptionError(
            f"{root} is not a folder; give the folder that holds the scenes' folders."
        )
    if not model_pattern.strip():
        raise OptionError("`model_pattern` is empty; name a path with {scene}, or leave it out.")
    scenes = []
    for entry in sorted(path for path in root.iterdir() if path.is_dir()):
        model = Path(fill(model_pattern, folder=folder, scene=entry.name))
        if model.exists():
            images = image_folder(name, entry.name)
            scenes.append(BenchScene(entry.name, model, entry, name, images))
    if not scenes:
        wanted = fill(model_pattern, folder=folder, scene="SCENE")
        raise OptionError(
            f"{root} holds no trained model {wanted}; give the right path with `model_pattern`."
        )
    return scenes


def fill(pattern: str, **values: str) -> str:
    """Replace the placeholders of a pattern by the values.

    Raises:
        OptionError: The pattern has an unknown placeholder or an unmatched brace.
    """
    plain = {(None, None, None), *((name, "", None) for name in values)}  # no {name.x}, {name!r}
    with suppress(ValueError):  # an unmatched brace
        if plain.issuperset(part[1:] for part in Formatter().parse(pattern)):
            return pattern.format(**values)
    known = ", ".join(f"{{{name}}}" for name in values)
    raise OptionError(f"{pattern!r} may hold {known} and no other braces.")


@dataclass(frozen=True, slots=True, eq=False)
class SceneViews:
    """The reference views that a scene's results are compared with.

    Attributes:
        sets: The sets of views to score, by label: kind and size; "" for photographs.
        fit_cameras: Views that methods may learn from, none of them scored.
        trained: Whether `fit_cameras` are those of training photographs, so that presets use them.
        background: RGB in [0, 1].
        against: Whether the views are photographs or renders of the original model.
        notes: Remarks that matter for reading the numbers.
    """

    sets: "Mapping[str, Sequence[ReferenceView]]"
    fit_cameras: tuple[Camera, ...]
    trained: bool
    background: Background
    against: Against
    notes: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """Number of views of the first set."""
        return len(next(iter(self.sets.values())))

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the first set's views; no photograph is read."""
        views = next(iter(self.sets.values()))
        if isinstance(views, PhotoViews):
            return views.cameras
        return tuple(view.camera for view in views)


def scene_views(scene: BenchScene, splats: Splats, settings: BenchSettings) -> SceneViews:
    """Return photographs of the test split if the scene has them, else renders of the model.

    Args:
        scene: The scene.
        splats: Its model.
        settings: Number and size of automatic views.

    Raises:
        NanogsError: The data set, or one of its splits, cannot be read, it has no test split, or no
            view shows anything.
    """
    if scene.photos is None:
        return _automatic_views(scene, splats, settings)
    return _photographs(scene, splats, settings)


def takes_automatic_views(scene: BenchScene) -> bool:
    """Return whether automatic views may be made for a scene, to measure on or to learn from."""
    from nanogs.datasets.dataset import open_dataset

    if scene.photos is None:
        return True
    try:
        open_dataset(scene.photos, images=scene.images).split("train")
    except NanogsError:  # no training views; or it cannot be read, for which the run has the reason
        return True
    return False


def _fit_cameras(scene: BenchScene, splats: Splats, settings: BenchSettings) -> tuple[Camera, ...]:
    """Return automatic views for the baselines to learn from."""
    from nanogs.views.automatic import automatic_cameras

    size, kind = settings.sizes[0], KINDS.get(settings.kinds[0], "auto")
    return tuple(
        automatic_cameras(
            splats, settings.fit_views, width=size, height=size, kind=kind, up=scene.up
        )
    )


def _automatic_views(scene: BenchScene, splats: Splats, settings: BenchSettings) -> SceneViews:
    from nanogs.raster.rendering import prepare
    from nanogs.scoring.scores import reference_views
    from nanogs.scoring.view_sets import view_sets

    prepared = prepare(splats)
    sizes = [(size, size) for size in settings.sizes]
    sets: dict[str, Sequence[ReferenceView]] = {}
    notes: list[str] = []
    for asked in view_sets(splats, settings.kinds, sizes, views=settings.views, up=scene.up):
        views, empty = reference_views(prepared, asked.cameras, BLACK, depth=False)
        sets[f"{asked.kind} {views[0].camera.width}"] = views
        notes += asked.notes
        if empty:
            what = counted(len(empty), "view shows nothing and is", "views show nothing and are")
            notes.append(f"{what} left out: {', '.join(empty)}")
    fit = _fit_cameras(scene, splats, settings)
    return SceneViews(
        sets, fit, trained=False, background=BLACK, against=Against.ORIGINAL,
        notes=tuple(dict.fromkeys(notes)),
    )  # fmt: skip


def _photographs(scene: BenchScene, splats: Splats, settings: BenchSettings) -> SceneViews:
    from nanogs.datasets.dataset import open_dataset

    folder = scene.photos
    assert folder is not None  # noqa: S101 - asked by the caller
    if scene.images in IMAGE_SCALES and folder.is_dir() and not (folder / scene.images).is_dir():
        raise FormatError(
            f"{folder / scene.images}: is no folder; copy the photographs there, scaled to"
            f" {IMAGE_SCALES[scene.images]} of their width, as is usual for this data set"
        )
    dataset = open_dataset(folder, images=scene.images)
    frames = dataset.split("test")
    background = settings.background or dataset.background(frames)
    notes: tuple[str, ...] = (f"photographs over {background_text(background)}",)
    trained = True
    try:
        fit = tuple(frame.camera for frame in dataset.split("train"))
    except NoViewsError as error:
        trained, fit = False, _fit_cameras(scene, splats, settings)
        notes += (f"methods learn from automatic views, as there are no training views: {error}",)
    photos = PhotoViews(dataset, frames, background)
    notes += photos.notes
    return SceneViews({"": photos}, fit, trained, background, Against.PHOTOGRAPHS, notes)
