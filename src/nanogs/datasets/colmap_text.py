"""COLMAP's `cameras.txt` and `images.txt`: one line per camera, two per image, # for comments."""

from collections.abc import Iterator
from pathlib import Path

from nanogs.datasets import fields
from nanogs.datasets.colmap_models import BY_NAME, ColmapCamera, ColmapImage, unknown_model
from nanogs.errors import FormatError

_IMAGE_FIELDS = 10  # id, quaternion, translation, camera id, name; the name may hold spaces


def read_cameras_text(path: Path) -> list[ColmapCamera]:
    """Read `cameras.txt` in the file's order.

    Raises:
        FormatError: It is missing, a line cannot be read, or a camera model is unknown.
    """
    return [
        _camera(line.split(), f"{path}, line {number}")
        for number, line in _lines(path)
        if _holds_data(line)
    ]


def read_images_text(path: Path) -> list[ColmapImage]:
    """Read `images.txt` in the file's order, without the observations.

    Raises:
        FormatError: It is missing, a line cannot be read, or an image lacks its second line.
    """
    images = []
    lines = _lines(path)
    for number, line in lines:
        if _holds_data(line):
            images.append(_image(line, f"{path}, line {number}"))
            # The second line exists even if it is empty, for an image without observations.
            below, observations = next(lines, (number + 1, ""))
            _check_observations(observations.split(), f"{path}, line {below}")
    return images


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    return enumerate(fields.read_text(path).split("\n"), start=1)


def _holds_data(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _camera(words: list[str], where: str) -> ColmapCamera:
    if len(words) > 1 and words[1] not in BY_NAME:
        raise unknown_model(where, fields.shown(words[1]))
    try:
        model = BY_NAME[words[1]]
        camera_id, width, height = (int(word) for word in (words[0], *words[2:4]))
        params = tuple(float(word) for word in words[4:])
    except (ValueError, IndexError) as error:
        raise _unreadable(where, "a camera") from error
    if len(params) != model.count:
        raise FormatError(
            f"{where}: model {model.name} has {model.count} parameters, not {len(params)}; "
            "export the model again from COLMAP."
        )
    return ColmapCamera(camera_id, model, (width, height), params)


def _image(line: str, where: str) -> ColmapImage:
    words = line.strip().split(maxsplit=_IMAGE_FIELDS - 1)
    try:
        image_id, camera_id, name = int(words[0]), int(words[8]), words[9]
        pose = tuple(float(word) for word in words[1:8])
    except (ValueError, IndexError) as error:
        raise _unreadable(where, "an image") from error
    return ColmapImage(image_id, pose[:4], pose[4:], camera_id, name)


def _check_observations(words: list[str], where: str) -> None:
    # Otherwise every other image of a file without the second lines would be lost silently.
    try:
        if len(words) % 3:
            raise ValueError
        for word in words[-3:]:
            float(word)
    except ValueError as error:
        raise FormatError(
            f"{where}: must be the list of observations of an image; keep a line, which may be"
            " empty, below the line of each image."
        ) from error


def _unreadable(where: str, noun: str) -> FormatError:
    return FormatError(f"{where}: is not {noun}; export the model again from COLMAP.")
