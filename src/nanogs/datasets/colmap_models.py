"""COLMAP's camera models: pinhole intrinsics and lens distortion."""

from dataclasses import dataclass

from nanogs.datasets import fields
from nanogs.errors import FormatError
from nanogs.raster.lens import Lens


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A COLMAP camera model: the layout of its parameters.

    Attributes:
        name: COLMAP's name of it.
        count: Number of parameters.
        focals: 1 if fx and fy are one parameter, 2 if they are two.
        order: Names of the distortion parameters, which follow the principal point.
        fisheye: Whether it is a fisheye, which distorts even if all parameters are 0.
        known: Whether its photographs can be undistorted.
    """

    name: str
    count: int
    focals: int
    order: tuple[str, ...] = ()
    fisheye: bool = False
    known: bool = True


_OPENCV = ("k1", "k2", "p1", "p2")
_FULL = (*_OPENCV, "k3", "k4", "k5", "k6")
_FISHEYE = ("k1", "k2", "k3", "k4")
# The index in this list is the model's id in binary files.
MODELS = (
    CameraModel("SIMPLE_PINHOLE", 3, 1),
    CameraModel("PINHOLE", 4, 2),
    CameraModel("SIMPLE_RADIAL", 4, 1, ("k1",)),
    CameraModel("RADIAL", 5, 1, ("k1", "k2")),
    CameraModel("OPENCV", 8, 2, _OPENCV),
    CameraModel("OPENCV_FISHEYE", 8, 2, _FISHEYE, fisheye=True),
    CameraModel("FULL_OPENCV", 12, 2, _FULL),
    CameraModel("FOV", 5, 2, known=False),
    CameraModel("SIMPLE_RADIAL_FISHEYE", 4, 1, ("k1",), fisheye=True),
    CameraModel("RADIAL_FISHEYE", 5, 1, ("k1", "k2"), fisheye=True),
    CameraModel("THIN_PRISM_FISHEYE", 12, 2, fisheye=True, known=False),
)
BY_NAME = {model.name: model for model in MODELS}


@dataclass(frozen=True, slots=True)
class ColmapCamera:
    """One entry of `cameras.bin` or `cameras.txt`.

    Attributes:
        camera_id: Id that images refer to.
        model: Its camera model.
        size: Width and height in pixels.
        params: The model's parameters in COLMAP's order: focal lengths, principal point in pixels
            from the image's top left corner, distortion.
    """

    camera_id: int
    model: CameraModel
    size: tuple[int, int]
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ColmapImage:
    """One entry of `images.bin` or `images.txt`.

    Attributes:
        image_id: COLMAP's id of it.
        quaternion: Rotation from world to camera, wxyz.
        translation: Translation from world to camera, scene units.
        camera_id: Id of the camera that took it.
        name: The photograph's path inside the image folder.
    """

    image_id: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
    name: str


def intrinsics(camera: ColmapCamera) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return a camera's focal lengths (fx, fy) and principal point (cx, cy), in pixels."""
    model, params = camera.model, camera.params
    fx, fy = params[0], params[model.focals - 1]
    return (fx, fy), (params[model.focals], params[model.focals + 1])


def lens_of(camera: ColmapCamera, where: str) -> Lens:
    """Return a camera's lens, which may be one without distortion.

    Raises:
        FormatError: A parameter is not finite.
    """
    model = camera.model
    values = [fields.number(value, f"{where}, lens") for value in camera.params[model.focals + 2 :]]
    if not model.known:  # with all parameters 0, every model but a fisheye is a pinhole
        return Lens(model.name, fisheye=model.fisheye, known=not any(values) and not model.fisheye)
    given = dict(zip(model.order, values, strict=True))
    above, below = (_FISHEYE, ()) if model.fisheye else (("k1", "k2", "k3"), ("k4", "k5", "k6"))
    return Lens(
        model.name,
        fisheye=model.fisheye,
        above=tuple(given.get(name, 0.0) for name in above),
        below=tuple(given.get(name, 0.0) for name in below),
        tangential=(given.get("p1", 0.0), given.get("p2", 0.0)),
    )


def unknown_model(where: str, given: object) -> FormatError:
    """Return the error for a camera model that is not in `MODELS`."""
    return FormatError(
        f"{where}: camera model {given} is not known; "
        "undistort photographs and cameras with colmap image_undistorter."
    )
