"""Data sets of photographs with cameras, of NeRF-Synthetic, nerfstudio and COLMAP; camera files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from nanogs._types import F32, F
from nanogs.datasets.blender import read_transforms, split_transforms
from nanogs.datasets.colmap import find_model, read_model, scaled
from nanogs.datasets.fields import read_json
from nanogs.datasets.frame import Frame
from nanogs.datasets.inria import read_cameras_json
from nanogs.datasets.nerfstudio import (
    CHANGE_FILE,
    find_change,
    moved,
    read_camera_path,
    refuse_lone,
)
from nanogs.datasets.photos import find_photo, is_transparent, photo_size, read_photo
from nanogs.datasets.undistort import straightened, undistorted
from nanogs.errors import FormatError, NoViewsError, OptionError
from nanogs.paths import exists, is_file, is_folder, why_refused
from nanogs.raster.camera import Camera

Kind = Literal["blender", "colmap"]
Split = Literal["test", "train"]

TEST_EVERY = 8  # the field's convention for COLMAP captures: every 8th image is held out
_TRANSFORMS = ("transforms.json", "transforms_train.json", "transforms_val.json")
_BLENDER_FILES = (*_TRANSFORMS, "transforms_test.json")


@dataclass(frozen=True, slots=True)
class Dataset:
    """Photographs with cameras, split into training and test views.

    Attributes:
        kind: "blender" for `transforms_*.json`, or one `transforms.json` as nerfstudio writes it;
            "colmap" for a sparse model.
        path: The data set's folder.
        images: The folder of a COLMAP capture's photographs; None for Blender, whose camera files
            hold the photographs' paths.
    """

    kind: Kind
    path: Path
    images: Path | None = None

    @property
    def camera_files(self) -> list[Path]:
        """The files that decide the cameras of both splits."""
        if self.images is None:
            names = ("transforms_test.json", "transforms_train.json", "transforms.json")
            files = [self.path / name for name in names]
        else:
            files = sorted((_sparse(self.path) or self.path).iterdir())
        return [file for file in (*files, self.path / CHANGE_FILE) if is_file(file)]

    def split(self, name: Split) -> list[Frame]:
        """Return one split's frames; only the sizes of photographs are read.

        COLMAP: of the images sorted by name, every 8th from the first on is a test view; intrinsics
        are scaled to the photograph's size. Blender: `transforms_test.json` or
        `transforms_train.json` in the file's order, or those frames of a `transforms.json` that
        nerfstudio tests or trains on (see `nerfstudio.test_images`).

        Args:
            name: "test" or "train".

        Returns:
            At least one frame; each has a photograph, and a camera without lens distortion.

        Raises:
            NoViewsError: The split is missing or empty.
            FormatError: A photograph or a camera is missing or unusable, a photograph has another
                size than its camera, or cannot be undistorted.
            OptionError: `name` is not a split.
        """
        if name not in ("test", "train"):
            raise OptionError(f"split {name!r}: choose 'test' or 'train'.")
        frames = self._blender(name) if self.images is None else self._colmap(name, self.images)
        if not frames:
            raise NoViewsError(
                f"{self.path}: its few images leave none for the {name} split; use a larger set."
            )
        return frames

    def background(self, frames: Sequence[Frame]) -> tuple[float, float, float]:
        """Return the conventional background of the photographs, RGB: white or black.

        White for NeRF-Synthetic photographs with transparency, because models are trained on them
        over white; black for all others.

        Args:
            frames: Frames of a split; the photograph of the first one decides.

        Raises:
            FormatError: That photograph cannot be read.
        """
        photo = frames[0].photo_path if frames else None
        over_white = self.kind == "blender" and photo is not None and is_transparent(photo)
        return (1.0, 1.0, 1.0) if over_white else (0.0, 0.0, 0.0)

    def load_photo(self, frame: Frame, background: Sequence[float] | F) -> F32:
        """Decode one frame's photograph, composited over a background.

        Lens distortion is removed, so that the photograph fits the frame's pinhole camera.

        Args:
            frame: A frame of this data set.
            background: Three numbers in [0, 1], RGB.

        Returns:
            (height, width, 3) float32 in [0, 1], RGB, row 0 on top.

        Raises:
            FormatError: There is no photograph, it is damaged, or of another size than the camera.
            OptionError: The background is not three numbers in [0, 1].
        """
        size = frame.camera.width, frame.camera.height
        photo = read_photo(
            _present(frame.photo_path, self.path, frame.camera.name), size, background
        )
        return undistorted(photo, frame.taken_by, frame.camera) if frame.taken_by else photo

    def _blender(self, name: Split) -> list[Frame]:
        whole, file = self.path / "transforms.json", self.path / f"transforms_{name}.json"
        others = any(is_file(self.path / f"transforms_{each}.json") for each in ("test", "train"))
        if is_file(file):
            frames = read_transforms(file)
        elif is_file(whole) and not others:
            file, (trained, held_out) = whole, split_transforms(whole)
            frames = held_out if name == "test" else trained
        else:
            raise NoViewsError(
                f"{self.path}: has no {name} split; put its cameras into {file.name}."
            )
        return [
            replace(
                _straight(frame.camera, _present(frame.photo_path, file, frame.camera.name)),
                masked=frame.masked,
            )
            for frame in frames
        ]

    def _colmap(self, name: Split, images: Path) -> list[Frame]:
        cameras = _read_sparse(_sparse(self.path) or self.path, self.path)
        held_out = name == "test"
        chosen = [
            camera for index, camera in enumerate(cameras) if (index % TEST_EVERY == 0) == held_out
        ]
        return [_frame_in(images, camera) for camera in chosen]


def open_dataset(path: str | Path, *, images: str | None = None) -> Dataset:
    """Open a data set, and detect the layout of its folder.

    A folder with `sparse/0` is a COLMAP capture, one with `transforms_*.json` is NeRF-Synthetic,
    one with a `transforms.json` alone is nerfstudio's; a folder with both kinds counts as a COLMAP
    capture, like in the reference trainer.

    Args:
        path: The data set's folder.
        images: Folder of the photographs within a COLMAP capture: "images" (the default),
            "images_2", "images_4", "images_8" or another.

    Raises:
        FormatError: The folder has neither layout, or no photographs.
        OptionError: `images` is empty or not a folder, or is given for NeRF-Synthetic.
    """
    if images is not None and not images.strip():
        raise OptionError("`images` is empty; name a folder of photographs, or leave it out.")
    folder = Path(path)
    if refusal := why_refused(folder):
        raise FormatError(f"{folder}: cannot be read ({refusal}); check the path.")
    if not exists(folder):
        raise FormatError(f"{folder}: does not exist; check the path.")
    if not is_folder(folder):
        raise FormatError(
            f"{folder}: is not a folder, but the photographs are needed besides the cameras; give"
            " the folder of the data set."
        )
    if _sparse(folder) is not None:
        return Dataset("colmap", folder, _image_folder(folder, images))
    if not any(is_file(folder / name) for name in _BLENDER_FILES):
        raise FormatError(
            f"{folder}: holds neither transforms_test.json nor sparse/0 with photographs, nor a"
            " transforms.json; give the folder of a NeRF-Synthetic, nerfstudio or COLMAP data set."
        )
    if images is not None:
        raise OptionError(
            f"{folder}: its transforms files say where the photographs are; leave `images` out."
        )
    return Dataset("blender", folder)


def cameras_from_file(path: str | Path) -> list[Camera]:
    """Read cameras to render from; photographs are not needed.

    Args:
        path: A `transforms*.json`, a `cameras.json` of the reference trainer, a `camera_path.json`
            of nerfstudio, or a folder: a COLMAP sparse model, a folder with one in `sparse/0`, or a
            folder with such JSON files (but no camera path).

    Returns:
        All cameras, with the sizes that the file states, else with those of its photographs. Those
        of a COLMAP model are sorted by name, others are in the file's order, files in the order
        train, validation, test; a camera in several files is returned once. Lens distortion is in
        `Camera.lens`, and renders do not include it. Beside nerfstudio's
        `dataparser_transforms.json` they are in the coordinates of its model.

    Raises:
        FormatError: The file is missing or damaged, has an unknown layout, or states no size.
    """
    place = Path(path)
    model = find_model(place)
    if model is not None:
        return _read_sparse(model, place)
    found: list[Camera] = []
    for file in _camera_files(place):  # transforms.json may repeat the cameras of the splits
        known = set(map(_view, found))
        found += [camera for camera in _from_json(file) if _view(camera) not in known]
    return found


def _view(camera: Camera) -> tuple[str, bytes]:
    return camera.name, camera.world_to_camera.tobytes()


def _camera_files(place: Path) -> list[Path]:
    if not is_folder(place):
        if place.suffix in (".bin", ".txt") and find_model(place.parent) == place.parent:
            raise FormatError(f"{place}: is one file of a COLMAP model; give its folder.")
        return [place]
    files = [place / name for name in _BLENDER_FILES if is_file(place / name)]
    if not files and is_file(place / "cameras.json"):
        files = [place / "cameras.json"]
    if not files:
        raise FormatError(
            f"{place}: holds no cameras; give a transforms.json, a cameras.json or a folder with "
            "sparse/0."
        )
    return files


def _from_json(file: Path) -> list[Camera]:
    # Distinguished by content, because people rename these files.
    document = read_json(file)
    refuse_lone(document, file)
    if isinstance(document, list):
        return read_cameras_json(file)
    if isinstance(document, dict) and "camera_path" in document:
        return read_camera_path(file)
    return [frame.camera for frame in read_transforms(file)]


def _read_sparse(model: Path, folder: Path) -> list[Camera]:
    """Read a sparse model, and move its cameras if the data set's folder says so."""
    change = find_change(folder)
    cameras = read_model(model)
    return cameras if change is None else [moved(camera, change) for camera in cameras]


def _sparse(folder: Path) -> Path | None:
    # A sparse model in `folder` itself has cameras but no photographs, so it is no data set.
    model = find_model(folder)
    return None if model == folder else model


def _image_folder(folder: Path, images: str | None) -> Path:
    chosen = folder / ("images" if images is None else images)
    if is_folder(chosen):
        return chosen
    others = sorted(path.name for path in folder.glob("images*") if path.is_dir())
    remedy = f'choose `images="{others[0]}"`' if others else "copy the photographs there"
    if others and images is None:  # `nanogs bench` has no such option
        remedy += ", or rename that folder to images"
    problem = FormatError if images is None else OptionError
    raise problem(f"{chosen}: is no folder of photographs; {remedy}.")


def _frame_in(images: Path, camera: Camera) -> Frame:
    photo = _present(find_photo(images, camera.name), images, camera.name)
    return _straight(scaled(camera, photo_size(photo), str(photo)), photo)


def _straight(camera: Camera, photo: Path) -> Frame:
    """Return a frame with a pinhole camera; `taken_by` keeps a camera with lens distortion."""
    if camera.lens is None:
        return Frame(camera, photo)
    return Frame(straightened(camera, str(photo)), photo, camera)


def _present(photo: Path | None, place: Path, name: str) -> Path:
    if photo is None:
        raise FormatError(f"{place}: has no photograph {name}; restore it or remove its camera.")
    return photo
